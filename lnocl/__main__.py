"""Run the command line as ``python -m lnocl``."""

from lnocl.commands.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
