"""Pictures of the results of `service.analysis`, for ``rotorwatch plot``."""
