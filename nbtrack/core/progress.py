"""One progress bar: a line that moves where somebody watches, elsewhere a line now and then."""

import sys
import threading
import time
from typing import Any

from tqdm import tqdm

_DELAY_SECONDS = 1.0  # so that a mistake which ends the work at once is told alone
_FORMAT = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"
# Where nobody watches: seconds before the first line, between two later ones, and their form.
_FIRST_LINE_SECONDS, _LINE_SECONDS = 2.0, 30.0
_LINE_FORMAT = "{desc}: {percentage:.0f} %, {elapsed} gone, {remaining} left{postfix}"


def tell(news: str) -> None:
    """Print news: to standard error, since it is no result; notebooks would show that in red."""
    print(news, file=sys.stdout if _is_notebook() else sys.stderr)


def _is_notebook() -> bool:
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


class _NotebookLine:
    """A file whose text is one output of a notebook's cell, replaced at every write.

    It needs no widget, so that stored notebooks and exported pages end with the last text.
    """

    handle: Any = None

    def write(self, text: str) -> None:
        from IPython.display import display

        shown = {"text/plain": text.strip()}
        if not shown["text/plain"]:
            return
        if self.handle is None:
            self.handle = display(shown, raw=True, display_id=True)
        else:
            self.handle.update(shown, raw=True)


class ProgressBar:
    """Progress with an ETA over a known amount of work, to be used in a `with` block."""

    def __init__(self, title: str, total: float | int, is_shown: bool = True) -> None:
        is_notebook = _is_notebook()
        self.title, self.is_shown, self._start = title, is_shown, time.monotonic()
        # A notebook's kernel drops messages once a thousand wait to be read.
        file, pause = (_NotebookLine(), 1.0) if is_notebook else (sys.stderr, 0.1)
        is_hidden = not (is_shown and (is_notebook or sys.stderr.isatty()))
        where = {"file": file, "mininterval": pause, "disable": is_hidden, "ascii": False}
        self._bar = tqdm(total=total, desc=title, bar_format=_FORMAT, delay=_DELAY_SECONDS, **where)
        self._done, self._status, self._ended = 0.0, "", threading.Event()
        self._is_logged = is_shown and is_hidden

    def move_to(self, done: float | int, status: str = "") -> None:
        """Show how much is done, and a word on how it goes."""
        # Sums of fractions may end a rounding error above the total, which a bar does not like.
        done = self._done = min(done, self._bar.total)
        self._status = status
        self._bar.set_postfix_str(status, refresh=False)
        self._bar.update(done - self._bar.n)

    def __enter__(self) -> "ProgressBar":
        if self._is_logged:
            threading.Thread(target=self._log, daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        seconds = time.monotonic() - self._start
        self._ended.set()
        self._bar.close()
        if self._is_logged and kind is None and seconds > _DELAY_SECONDS:
            print(f"{self.title}: done in {seconds:.0f} s", file=sys.stderr)

    def _log(self) -> None:
        """Lines with an ETA from the mean speed, also while a long step has nothing to report."""
        pause = _FIRST_LINE_SECONDS
        while not self._ended.wait(pause):
            pause, seconds = _LINE_SECONDS, time.monotonic() - self._start
            how = {"prefix": self.title, "postfix": self._status, "bar_format": _LINE_FORMAT}
            line = tqdm.format_meter(self._done, self._bar.total, seconds, **how)
            print(line, file=sys.stderr)
