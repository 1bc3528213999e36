"""The client: machines, health and alarms over HTTP; alarm logs over Zenoh (`service.client.alarm_log`)."""
