"""The pool of processes: order, errors, and that no process of it outlives its use or touches another."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from list3r.memory.core.errors import List3rError, OptionError
from list3r.pipeline.workers import OrderedPool, WorkerError
from tests.program import with_signals

ENDS_WITHIN_S = 20.0
"""A process ends within a second; a machine that is busy with other things takes longer to notice."""


def later(number: int) -> tuple[int, int]:
    """The first tasks take longest."""
    time.sleep(0.3 if number == 0 else 0.0)
    return number, os.getpid()


def fail(number: int) -> int:
    if number == 2:
        raise OptionError(f"number {number} is not wanted")
    return number


def die(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def sleep(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


class Odd(Exception):
    """Cannot be made again from its arguments."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(f"{one} and {two}")


def fail_oddly(number: int) -> object:
    if number:
        raise Odd("this", "that")
    return lambda: number


def chatter(number: int) -> int:
    sys.stdout.write("a worker says something\n")
    sys.stdout.flush()
    return number


@pytest.fixture
def two() -> Iterator[OrderedPool[int, tuple[int, int]]]:
    with OrderedPool(later, 2) as pool:
        yield pool


def alive(pid: int) -> bool:
    """Whether a process runs; one that nobody has waited for is over all the same."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def until(true: Callable[[], bool]) -> bool:
    end = time.monotonic() + ENDS_WITHIN_S
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.05)
    return False


def test_results_keep_the_order_of_tasks_and_come_from_both_processes(two: OrderedPool[int, tuple[int, int]]) -> None:
    results = list(two.map(range(8)))
    assert [number for number, _ in results] == list(range(8))
    pids = {pid for _, pid in results}
    assert len(pids) == 2 and os.getpid() not in pids


def test_no_task_is_begun_long_before_its_result_is_taken(two: OrderedPool[int, tuple[int, int]]) -> None:
    asked = []

    def tasks() -> Iterator[int]:
        for number in range(20):
            asked.append(number)
            yield number

    results = two.map(tasks())
    for taken in range(1, 6):
        next(results)
        assert len(asked) <= taken + 2


def test_a_question_is_answered_while_tasks_are_under_way(two: OrderedPool[int, tuple[int, int]]) -> None:
    results = two.map(range(6))
    found = [next(results)[0]]
    assert two.ask(fail, 7) == 7
    with pytest.raises(OptionError, match="not wanted"):
        two.ask(fail, 2)
    assert found + [number for number, _ in results] == list(range(6))


def test_an_error_comes_in_the_place_of_its_task_with_the_place_where_it_arose() -> None:
    with OrderedPool(fail, 2) as pool:
        results = pool.map(range(4))
        assert [next(results), next(results)] == [0, 1]
        with pytest.raises(OptionError, match="number 2 is not wanted") as caught:
            next(results)
        assert "in fail" in caught.value.__notes__[0]
        assert list(pool.map([3, 4])) == [3, 4]


def test_what_cannot_be_sent_back_is_an_error_with_its_words() -> None:
    with OrderedPool(fail_oddly, 1) as pool:
        with pytest.raises(RuntimeError, match="Odd: this and that"):
            list(pool.map([1]))
        with pytest.raises(Exception, match=r"(?i)pickle"):
            list(pool.map([0]))


def test_a_process_that_is_killed_gives_one_line_with_the_fix() -> None:
    with OrderedPool(die, 1) as pool:
        results = pool.map(range(3))
        assert next(results) == 0
        with pytest.raises(WorkerError, match=r"ended from outside \(signal 9\).*fewer --workers") as caught:
            next(results)
        assert isinstance(caught.value, List3rError) and "\n" not in str(caught.value)


def test_what_a_worker_prints_does_not_go_to_standard_output(capfd: pytest.CaptureFixture[str]) -> None:
    with OrderedPool(chatter, 1) as pool:
        assert list(pool.map([1])) == [1]
    out, err = capfd.readouterr()
    assert out == "" and "a worker says something" in err


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_the_callers_own_processes_live_on(method: str) -> None:
    own = multiprocessing.get_context(method).Process(target=time.sleep, args=(60,))
    other = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    own.start()
    try:
        with OrderedPool(sleep, 2) as pool:
            pids = set(pool.map([0.0] * 4))
            assert not {p.pid for p in multiprocessing.active_children()} & pids
            pool.ask(sleep, 0.0)
        assert not any(alive(pid) for pid in pids)
        assert own.is_alive() and other.poll() is None
    finally:
        own.kill()
        other.kill()
        own.join()
        other.wait()


def run_script(folder: Path, text: str) -> subprocess.Popen[str]:
    script = folder / "script.py"
    script.write_text(text, encoding="utf-8")
    root = str(Path(__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
    return subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=environment, preexec_fn=with_signals
    )


def test_a_script_without_a_guard_is_run_once(tmp_path: Path) -> None:
    script = run_script(
        tmp_path,
        "from list3r.pipeline.workers import OrderedPool\n"
        "import math\n"
        "with OrderedPool(math.factorial, 2) as pool:\n"
        "    print(list(pool.map(range(5))))\n",
    )
    out, _ = script.communicate(timeout=60)
    assert out == "[1, 1, 2, 6, 24]\n" and script.returncode == 0


def test_a_function_of_a_script_with_a_guard_is_found(tmp_path: Path) -> None:
    script = run_script(
        tmp_path,
        "from dataclasses import dataclass\n"
        "from list3r.pipeline.workers import OrderedPool\n"
        "@dataclass(frozen=True)\n"
        "class Number:\n"
        "    value: int\n"
        "def double(n: Number) -> Number:\n"
        "    return Number(2 * n.value)\n"
        "if __name__ == '__main__':\n"
        "    with OrderedPool(double, 2) as pool:\n"
        "        print(list(pool.map([Number(1), Number(2)])) == [Number(2), Number(4)])\n",
    )
    out, _ = script.communicate(timeout=60)
    assert out == "True\n" and script.returncode == 0


BUSY = """
import os, sys
from list3r.pipeline.workers import OrderedPool
import tests.test_workers as here
with OrderedPool(here.sleep, 2) as pool:
    print(*{pid for pid in pool.map([0.3] * 4)}, flush=True)
    child = os.fork()  # holds copies of all that the parent has open
    if child == 0:
        here.time.sleep(60)
        os._exit(0)
    print(child, flush=True)
    list(pool.map([60.0] * 4))
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_workers_end_when_their_parent_is_ended(tmp_path: Path, how: signal.Signals) -> None:
    script = run_script(tmp_path, BUSY)
    assert script.stdout is not None
    workers = [int(word) for word in script.stdout.readline().split()]
    child = int(script.stdout.readline())
    try:
        assert len(workers) == 2 and all(alive(pid) for pid in workers)
        script.send_signal(how)
        script.wait(timeout=ENDS_WITHIN_S)
        assert until(lambda: not any(alive(pid) for pid in workers))
        assert alive(child)
    finally:
        script.kill()
        os.kill(child, signal.SIGKILL)
        script.stdout.close()


def test_processes_that_were_started_before_serve_the_tasks() -> None:
    """What they do first may fail; of those that were started only as many are kept as there are tasks."""
    with OrderedPool(later, 3) as pool:
        pool.start(die_of_nothing, 7)
        pool.keep(2)
        found = list(pool.map(range(5)))
    assert [number for number, _ in found] == list(range(5))
    assert 1 <= len({process for _, process in found}) <= 2


def die_of_nothing(number: int) -> None:
    raise OptionError(f"number {number} cannot get ready")
