"""The live loop around the estimator."""
