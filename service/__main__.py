"""The program ``rotorwatch`` as it is started: Ctrl-C while it still loads ends it as quietly as later."""

import sys


def main() -> None:
    """Load the commands, and run the one of the command line."""
    try:
        from service.commands.rotorwatch import app  # noqa: PLC0415  # takes a while

        app()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
