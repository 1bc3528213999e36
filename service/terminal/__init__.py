"""The programs' terminal: log lines, lines of text, stop requests (Ctrl-C); and memory settings of the process."""
