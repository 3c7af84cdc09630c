"""The thesis's own procedures: prediction, averages, adaptive run."""
