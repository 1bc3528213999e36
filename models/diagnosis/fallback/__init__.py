"""What is left where no equation can be evaluated: changed or not changed, channel by channel."""
