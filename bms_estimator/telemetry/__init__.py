"""Published payloads from the state of the estimator: state, parameters, health, alarms, info; totals of all runs."""
