"""Worlds, flights, baselines and reports for buildloc; the only reader of ground truth."""
