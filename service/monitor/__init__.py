"""The data path of one machine, pure: `service.monitor.monitor` is the first file to read."""
