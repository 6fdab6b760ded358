"""``python -m jaxloc``: the command line."""

from jaxloc.cli import main

if __name__ == "__main__":
    main()
