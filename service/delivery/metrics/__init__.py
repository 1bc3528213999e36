"""What the monitor does in numbers, for Prometheus; read out of snapshots when somebody asks."""
