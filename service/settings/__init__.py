"""Settings of the monitor: a TOML file, and environment variables over it; `service.settings.service` has the whole."""
