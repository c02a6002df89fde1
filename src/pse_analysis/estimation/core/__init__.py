"""What every estimator shares: its shape, snapshots, the run over them, triangular algebra."""
