"""Work on a file in a process of its own, which damage may end, hang or fill with numbers.

Compiled libraries trust what a file says of its own structure. There a crash is an error like
others. Systems without ``fork`` go without.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import pickle
import signal
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple


class Answer(NamedTuple):
    """What the work gave, or why it gave nothing."""

    value: Any = None
    error: str = ""


def apart(work: Callable[[], Any], *, seconds: int, bytes_at_most: int | None = None) -> Answer:
    """Return what a function gives within some time, and memory in addition to what is used."""
    if not hasattr(os, "fork"):
        return Answer(work())
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads are not touched
        process = os.fork()
    if process == 0:  # pragma: no cover
        try:
            _limit(seconds, bytes_at_most)
            answer = Answer(work())
        except BaseException as exc:
            answer = Answer(error=str(exc) or type(exc).__name__)
        with contextlib.suppress(BaseException), os.fdopen(writing, "wb") as pipe:
            pickle.dump(answer, pipe)
        os._exit(0)
    os.close(writing)
    timer = threading.Timer(2.0 * seconds, os.kill, (process, signal.SIGKILL))  # on the clock
    timer.start()
    with os.fdopen(reading, "rb") as pipe:
        content = pipe.read()
    timer.cancel()
    _, status = os.waitpid(process, 0)
    if status or not content:
        hung = os.waitstatus_to_exitcode(status) in (-signal.SIGXCPU, -signal.SIGKILL)
        return Answer(error=f"its reader {'hangs' if hung else 'fails'}")
    answer = pickle.loads(content)
    assert isinstance(answer, Answer)
    return answer


def _limit(seconds: int, bytes_at_most: int | None) -> None:  # pragma: no cover
    """Limit the processor time and the memory of this process, which prints nothing."""
    import resource

    faulthandler.disable()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    if bytes_at_most is not None:
        with contextlib.suppress(OSError):  # where there is no such file, the limit is the whole
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            bytes_at_most += pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (bytes_at_most, bytes_at_most))
