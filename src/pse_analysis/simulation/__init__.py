"""Raw telemetry of a simulated case, made from a grid, real load curves and a sensor layout."""
