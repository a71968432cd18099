"""`python -m nbtrack`."""

from nbtrack.interrupts import heed_interrupts

heed_interrupts()
from nbtrack.cli import main  # noqa: E402, only now: it takes a while

if __name__ == "__main__":
    raise SystemExit(main())
