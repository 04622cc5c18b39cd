"""`python -m qpavoid`."""

from qpavoid.cli import main

if __name__ == "__main__":
    main()
