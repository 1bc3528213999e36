"""What is studied: machines to commission, and streams of them, healthy and with something wrong."""
