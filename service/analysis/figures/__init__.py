"""Pictures of the results of `service.analysis`, one module per kind of ``rotorwatch plot``."""
