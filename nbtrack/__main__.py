"""`python -m nbtrack`."""

from nbtrack.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
