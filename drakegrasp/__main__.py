"""`python -m drakegrasp` is the program `drakegrasp`."""

from drakegrasp.cli.main import run

if __name__ == "__main__":
    run()
