"""Real-time Li-ion battery estimator: adaptive observer, parameters, SOC and stability margins."""

from importlib.metadata import version

__version__ = version("bms_estimator")
