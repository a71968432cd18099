"""One progress bar: a moving line at a terminal or in a notebook, elsewhere a line now and then."""

import os
import sys
import threading
from collections.abc import Collection
from typing import Any

from tqdm import tqdm

_DELAY_SECONDS = 1.0  # so that no bar stands before the message of a mistake that is found at once
# What matters first: in a narrow terminal the end of a line is cut off.
_FORMAT = "{percentage:3.0f} % |{bar:12}| {remaining} left, {desc}{postfix}"
# Where nobody watches: the form of a line, and seconds between two.
_LINE_FORMAT = "{desc}: {percentage:.0f} %, {elapsed} gone, {remaining} left{postfix}"
_LINE_SECONDS = 30.0
tqdm.set_lock(threading.RLock())  # its own is one between processes, which killed ones leave behind


def tell(news: str) -> None:
    """Print news: to standard error, since it is no result; notebooks would show that in red.

    At a terminal warnings are yellow, unless `NO_COLOR` is set.
    """
    has_colors = sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    if news.startswith("nbtrack: warning: ") and has_colors and not _is_notebook():
        news = f"\33[33m{news}\33[0m"
    print(news, file=sys.stdout if _is_notebook() else sys.stderr)


def _is_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


class _Line:
    """A file that shows each text written to it: as a line, or as the output of a notebook's cell.

    The latter needs no widget, so that stored notebooks and exported pages end with the last text.
    """

    handle: Any = None  # of the cell's output, once there is one

    def write(self, text: str) -> None:
        """Show a text without tqdm's carriage return and line end; blanks show nothing."""
        text = text.strip()
        if not text:
            return
        if not _is_notebook():
            print(text, file=sys.stderr)
        elif self.handle is None:
            from IPython.display import display

            self.handle = display({"text/plain": text}, raw=True, display_id=True)
        else:
            self.handle.update({"text/plain": text}, raw=True)


class ProgressBar(tqdm):
    """Progress with an ETA over a known amount of work, in a `with` block, or over a collection."""

    # Work done in a warm-up, and its seconds: its speed is not that of the rest.
    warm_up_work: float | int = 0
    warm_up_seconds = 0.0

    def __init__(self, title: str, work: float | Collection, is_shown: bool = True) -> None:
        """Begin; nothing is shown before a second has gone."""
        options = {"file": sys.stderr, "bar_format": _FORMAT}
        if _is_notebook():  # its kernel drops messages once a thousand wait to be read
            options |= {"file": _Line(), "mininterval": 1.0}
        elif not sys.stderr.isatty():
            options |= {"file": _Line(), "mininterval": _LINE_SECONDS, "bar_format": _LINE_FORMAT}
        # "miniters" 0: only the time decides when to show; "ascii" False: bars of block characters.
        options |= {"disable": not is_shown, "delay": _DELAY_SECONDS, "miniters": 0, "ascii": False}
        work_of = "iterable" if isinstance(work, Collection) else "total"
        super().__init__(desc=title, **{work_of: work}, **options)

    @property
    def format_dict(self) -> dict[str, Any]:
        """What is shown; the time that is left comes from the mean speed after the warm-up."""
        values = super().format_dict
        seconds = values["elapsed"] - self.warm_up_seconds
        return values | {"rate": (self.n - self.warm_up_work) / max(seconds, 1e-3)}

    def end_warm_up(self, done: float | int) -> None:
        """Leave the work that is done by now, and the time so far, out of the mean speed."""
        self.warm_up_work = done
        self.warm_up_seconds = self.format_dict["elapsed"]

    def move_to(self, done: float | int, status: str = "") -> None:
        """Show how much is done, and a word on how it goes."""
        self.set_postfix_str(status, refresh=False)
        # Sums of fractions may end a rounding error above the total, for which tqdm shows no bar.
        self.update(min(done, self.total) - self.n)
