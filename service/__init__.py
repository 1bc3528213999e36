"""The monitoring service; read `service.monitor.monitor` first, which holds the data path of one machine."""
