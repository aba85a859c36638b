"""The shared vocabulary of buildloc: what travels, what a footprint is, topics, frames, parameters."""
