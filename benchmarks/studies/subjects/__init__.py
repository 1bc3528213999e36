"""Subjects of the studies: machines to commission, and their streams, healthy and with faults."""
