"""One progress bar: a moving line at a terminal or in a notebook, elsewhere a line now and then."""

import os
import sys
import threading
from collections.abc import Collection
from typing import Any

from tqdm import tqdm

_DELAY_SECONDS = 1.0  # so that no bar is shown before the error of a command that fails at once
# The share comes first: in a narrow terminal the end of the line is cut off.
_FORMAT = "{percentage:3.0f} % |{bar:12}| {remaining} left, {desc}{postfix}"
# In a log file: the form of its lines, and the seconds between two of them.
_LINE_FORMAT = "{desc}: {percentage:.0f} %, {elapsed} gone, {remaining} left{postfix}"
_LINE_SECONDS = 30.0
# tqdm's own lock is shared between processes, and a killed process would leave it behind.
tqdm.set_lock(threading.RLock())


def tell(news: str) -> None:
    """Print news for the user.

    It goes to standard error, since it is no result of a command. In a notebook it goes to standard
    output, because notebooks show standard error in red. At a terminal, texts that begin with
    `nbtrack: warning: ` are yellow, unless `NO_COLOR` is set.
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
    """A file for tqdm outside of terminals, which shows each text that is written to it.

    In a notebook each text replaces the one before as the output of the cell. Without a widget,
    stored notebooks and exported pages show the last text. Elsewhere each text is a line of
    standard error.
    """

    handle: Any = None  # of the cell's output, once a text was shown

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
    """A progress bar with the time that is left.

    It is used in a `with` block with `move_to`, or as an iterator over a collection.
    """

    def __init__(self, title: str, work: float | Collection) -> None:
        """Begin a bar over a collection, or over an amount of work in any unit.

        Nothing is shown in the first second.
        """
        options = {"file": sys.stderr, "bar_format": _FORMAT}
        if _is_notebook():  # an update a second: a kernel drops messages once a thousand wait
            options |= {"file": _Line(), "mininterval": 1.0}
        elif not sys.stderr.isatty():
            options |= {"file": _Line(), "mininterval": _LINE_SECONDS, "bar_format": _LINE_FORMAT}
        # With "miniters" 0 only the time decides when to show; without "ascii" bars are of blocks.
        options |= {"delay": _DELAY_SECONDS, "miniters": 0, "ascii": False}
        work_of = "iterable" if isinstance(work, Collection) else "total"
        super().__init__(desc=title, **{work_of: work}, **options)

    def move_to(self, done: float | int, status: str = "") -> None:
        """Show how much of the work is done, and a word on how it goes."""
        self.set_postfix_str(status, refresh=False)
        # A sum of fractions may be larger than the total by a rounding error; tqdm then shows no
        # bar.
        self.update(min(done, self.total) - self.n)
