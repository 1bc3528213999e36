"""One machine's stream: in from Zenoh, through its own thread into the monitor and the history, and out again."""
