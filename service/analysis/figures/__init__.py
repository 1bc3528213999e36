"""Pictures of what `service.analysis` finds in recordings, by the kinds of ``rotorwatch plot``."""
