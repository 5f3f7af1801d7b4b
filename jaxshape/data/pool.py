"""Share work among processes; any of them may die, and all of them end with their parent. [host]

    for number, result in in_processes(function, items, workers=8):
        ...                                     # `Died` for an item that kills its process twice

A process works on one item at a time. The item of a process that dies is tried once more at the
end, alone, since memory may have run out.
"""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple


class Died(NamedTuple):
    """The result of an item that killed its process twice.

    Attributes:
        code: Exit status of the process; -9 if signal 9 killed it.
    """

    code: int

    def __str__(self) -> str:
        how = f"signal {-self.code}" if self.code < 0 else f"exit status {self.code}"
        return f"Its process ended with {how}, twice; memory may have run out."


class WorkersDied(ChildProcessError):
    """A process ended before it could begin to work."""


class _Worker:
    """A process that works on one item at a time.

    Attributes:
        process: The process.
        pipe: Items go in and results come out here.
        number: Number of the item that it works on; None before it has one.
    """

    def __init__(self, function: Callable[[Any], Any]):
        context = get_context("spawn")  # a fork of a process that runs threads may hang
        self.pipe, inside = context.Pipe()
        self.process: BaseProcess = context.Process(
            target=_serve, args=(function, inside), daemon=True
        )
        self.process.start()
        inside.close()  # so that the pipe closes when the process ends
        self.number: int | None = None
        self.is_ready = False

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def in_processes(
    function: Callable[[Any], Any], items: Sequence[Any], workers: int
) -> Iterator[tuple[int, Any]]:
    """Results of a function for each item, in the order in which they finish.

    Args:
        function: An importable and picklable function, with picklable arguments and results; its
            errors are raised here.
        items: Arguments of the function.
        workers: Number of processes, 1 or more; with 1 this process does the work.

    Yields:
        The index of an item in `items`, and its result or `Died`.

    Raises:
        WorkersDied: A process ended before it could begin to work.
    """
    if workers == 1 or len(items) < 2:
        yield from enumerate(map(function, items))
        return
    waiting, again, tried = deque(range(len(items))), deque(), set()
    crew = [_Worker(function) for _ in range(min(workers, len(items)))]
    try:
        while waiting or again or any(worker.number is not None for worker in crew):
            _share_out(crew, items, waiting, again)
            wait([w.pipe for w in crew] + [w.process.sentinel for w in crew])
            for worker in [w for w in crew if w.pipe.poll() or not w.process.is_alive()]:
                number, worker.number = worker.number, None
                try:
                    answer = worker.pipe.recv()
                except (EOFError, OSError):
                    answer = Died(_exit_code(worker))
                    crew[crew.index(worker)] = _Worker(function)
                worker.is_ready = True
                if number is None:  # it has started, or died while idle
                    continue
                if isinstance(answer, Died) and number not in tried:
                    tried.add(number)
                    again.append(number)
                    continue
                yield number, answer if isinstance(answer, Died) else answer()
    finally:
        for worker in crew:
            worker.end()


def _share_out(
    crew: list[_Worker], items: Sequence[Any], waiting: deque[int], again: deque[int]
) -> None:
    """Give items to idle processes; items that killed a process are tried one at a time."""
    for worker in crew:
        if not worker.is_ready or worker.number is not None:
            continue
        if waiting:
            worker.number = waiting.popleft()
        elif again and all(other.number is None for other in crew):
            worker.number = again.popleft()
        else:
            continue
        try:
            worker.pipe.send(items[worker.number])
        except OSError:  # it died while idle, which the caller notices next
            pass


def _exit_code(worker: _Worker) -> int:
    """The exit status of a process that died while working.

    Raises:
        WorkersDied: It had not begun to work.
    """
    worker.process.join()
    worker.pipe.close()
    code = worker.process.exitcode or 0
    if not worker.is_ready:
        raise WorkersDied(
            f"A worker process ended with exit status {code} before it began; give the same "
            "command again to resume, with fewer --workers if memory is short. (A script has to "
            "start processes under `if __name__ == '__main__':`.)"
        )
    return code


class _Returned(NamedTuple):
    """The answer of a process whose function returned.

    Attributes:
        value: The result of the function.
    """

    value: Any

    def __call__(self) -> Any:
        return self.value


class _Raised(NamedTuple):
    """The answer of a process whose function raised.

    Attributes:
        problem: The error that the function raised.
    """

    problem: Exception

    def __call__(self) -> Any:
        raise self.problem


def _serve(function: Callable[[Any], Any], pipe: Connection) -> None:
    """Main loop of a process: receive an item and send its result, until the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent also gets it, and ends this process
    threading.Thread(target=_die_with_parent, daemon=True).start()
    pipe.send(None)
    while True:
        try:
            item = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            answer = _Returned(function(item))
        except Exception as problem:
            answer = _Raised(problem)
        pipe.send(answer)


def _die_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
