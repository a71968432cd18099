"""One progress bar: a line that moves where somebody watches, elsewhere a line now and then."""

import sys
import threading
import time
from typing import Any

from tqdm import tqdm

_DELAY_SECONDS = 1.0  # so that a mistake which ends the work at once is told alone
_FORMAT = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"
# Where nobody watches: the form of a line, and seconds before the first and between later ones.
_LINE_FORMAT = "{desc}: {percentage:.0f} %, {elapsed} gone, {remaining} left{postfix}"
_FIRST_LINE_SECONDS, _LINE_SECONDS = 2.0, 30.0
tqdm.set_lock(threading.RLock())  # its own is one between processes, which killed ones leave behind


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
        is_notebook, form = _is_notebook(), _FORMAT
        self.title, self._start, self._ended = title, time.monotonic(), threading.Event()
        # A notebook's kernel drops messages once a thousand wait to be read.
        file, pause = (_NotebookLine(), 1.0) if is_notebook else (sys.stderr, 0.1)
        self._is_logged = is_shown and not (is_notebook or sys.stderr.isatty())
        if self._is_logged:  # never by itself: `_log` asks for what would be shown
            form, pause = _LINE_FORMAT, float("inf")
        # Without smoothing the ETA comes from the mean speed, not from that of the last step.
        options = {"mininterval": pause, "disable": not is_shown, "ascii": False, "smoothing": 0}
        options |= {"file": file, "bar_format": form, "delay": _DELAY_SECONDS}
        self._bar = tqdm(total=total, desc=title, **options)

    def move_to(self, done: float | int, status: str = "") -> None:
        """Show how much is done, and a word on how it goes."""
        # Sums of fractions may end a rounding error above the total, which a bar does not like.
        done = min(done, self._bar.total)
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
        """A line now and then, also while a long step has nothing to report."""
        pause = _FIRST_LINE_SECONDS
        while not self._ended.wait(pause):
            print(self._bar, file=sys.stderr)
            pause = _LINE_SECONDS
