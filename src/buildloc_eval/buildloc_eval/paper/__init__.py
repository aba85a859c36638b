"""`buildloc eval paper`: the paper's experiments on open data, with its baselines and its own figures."""
