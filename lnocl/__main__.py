"""Run the command line as ``python -m lnocl``."""

from lnocl.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
