"""What the programs say where they are started: log lines, lines of text, and Ctrl-C."""
