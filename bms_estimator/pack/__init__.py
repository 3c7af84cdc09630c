"""One pack: samples in, estimates out. Its stages are the estimator, the slow fit, the single cells and the forecast."""
