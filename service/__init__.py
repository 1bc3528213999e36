"""The monitoring service; ``service.monitor`` holds the data path of one machine and is the first file to read."""
