"""`buildloc eval integrity`: a Monte-Carlo of flights without images, negative controls among them."""
