"""Joint state and parameter EKF: filter bank, noise, input checks, OCV correction, element map."""
