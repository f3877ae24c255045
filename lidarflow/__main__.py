"""`python -m lidarflow` is the command line."""

from lidarflow.cli import main

if __name__ == "__main__":
    main()
