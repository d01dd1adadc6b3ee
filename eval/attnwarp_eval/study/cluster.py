"""Cells on a cluster of worker processes (dask): a local one, or the user's."""

from __future__ import annotations

import concurrent.futures
import contextlib
import json
import logging
import multiprocessing
import queue
import signal
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attnwarp.errors import InputError
from attnwarp.process import core_count
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.record import Failure
from attnwarp_eval.study.remote import (
    Code,
    Parcel,
    code_of_worker,
    compute_and_send,
    files_of_scene,
    this_code,
    unpack,
)
from attnwarp_eval.study.reporting import CellReporter
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.work import compute_and_write, failure

if TYPE_CHECKING:
    from distributed import Client, Future

ATTEMPTS = 2
"""Workers that a cell may lose. The first may die of anything; the second dies of the cell."""

POLL_SECONDS = 0.5
"""Seconds between two polls of the list of workers."""

CONNECT_SECONDS = 30
"""Seconds until a scheduler counts as unreachable, at the start or after a broken connection."""

REFUSED_SECONDS = 60
"""Seconds that a run waits after every worker was refused, since others may be starting."""

MOST_REQUESTS = 1000
"""Limit of tasks that request workers of an adaptive cluster; more would load its scheduler."""

Ended = tuple[Cell, Failure | None]
"""A cell and its failure, None if it succeeded."""


class ClusterError(InputError):
    """A cluster that cannot be used; the message names it and the remedy."""


class ClusterLost(Exception):  # noqa: N818  the field's word for it
    """The connection to a cluster broke in the middle of a run."""


class Workplace(ABC):
    """Interface of a cluster to the runner: send a cell to a worker, and receive its result."""

    adaptive = False
    """True if the cluster may start workers when there is work for them."""

    @abstractmethod
    def submit(self, client: Client, worker: str, cell: Cell) -> Future:
        """Send a cell to a worker."""

    @abstractmethod
    def receive(self, cell: Cell, result: Any) -> Failure | None:
        """Take a worker's result; the record of a finished cell is then on disk."""

    @abstractmethod
    def forget(self, worker: str) -> None:
        """Drop the state of a lost worker; another may get its address."""


class _Local(Workplace):
    """Workers on this machine, which write to the run's folder directly."""

    def __init__(self, root: Path, threads: int) -> None:
        self.root = str(root.resolve())
        self.threads = threads

    def submit(self, client: Client, worker: str, cell: Cell) -> Future:
        # The probe travels with its cell, so that a worker needs no registration.
        return client.submit(
            compute_and_write,
            probe(cell.probe),
            cell,
            self.root,
            self.threads,
            workers=[worker],
            pure=False,
        )

    def receive(self, cell: Cell, result: Any) -> Failure | None:
        error: Failure | None = result
        return error

    def forget(self, worker: str) -> None:
        """Local workers hold no state to drop."""


class _Remote(Workplace):
    """Workers anywhere: scenes travel to them, records and pictures come back."""

    adaptive = True

    def __init__(self, store: Store, scenes: Mapping[str, Scene]) -> None:
        self.store = store
        self.scenes = scenes
        self._sent: set[tuple[str, str]] = set()

    def submit(self, client: Client, worker: str, cell: Cell) -> Future:
        files = None
        if cell.scene in self.scenes and (worker, cell.scene) not in self._sent:
            self._sent.add((worker, cell.scene))
            files = files_of_scene(self.scenes[cell.scene])
        return client.submit(
            compute_and_send, probe(cell.probe), cell, files, workers=[worker], pure=False
        )

    def receive(self, cell: Cell, result: Parcel | Failure) -> Failure | None:
        if isinstance(result, Failure):
            # The files may be at fault: the scene's next worker receives them again.
            self._sent = {sent for sent in self._sent if sent[1] != cell.scene}
            return result
        return unpack(result, self.store)

    def forget(self, worker: str) -> None:
        self._sent = {sent for sent in self._sent if sent[0] != worker}


def run_on_workers(
    cells: list[Cell], root: Path, jobs: int, report: CellReporter
) -> Generator[Ended]:
    """Compute and write cells on this machine, one process a worker; yield each as it
    ends, with its failure.
    """
    threads = max(1, core_count() // jobs)
    # dask has workers return freed memory to the system at once; image-sized arrays then cost more
    # page faults than arithmetic.
    memory = {
        "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 30,
        "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 30,
    }
    settings = {
        **memory,
        "distributed.worker.memory.terminate": False,
        # dask samples the worker's stack 100 times a second for a dashboard that is not used.
        "distributed.worker.profile.enabled": False,
        "distributed.nanny.pre-spawn-environ.OMP_NUM_THREADS": threads,
        "distributed.nanny.pre-spawn-environ.MKL_NUM_THREADS": threads,
    }
    with contextlib.ExitStack() as stack:
        # Entered first, so that it exits last: a closing cluster makes dask log broken connections.
        stack.enter_context(_silent())
        import dask

        stack.enter_context(dask.config.set(settings))
        client = stack.enter_context(_local_client(jobs))
        yield from _Runner(client, cells, _Local(root, threads), report).run()


@contextlib.contextmanager
def _local_client(jobs: int) -> Iterator[Client]:
    """Start worker processes on this machine, and connect a client.

    A cluster starts and ends in a thread. Meanwhile, processes left by an error or Ctrl-C are
    killed: dask itself waits for starting processes and for running cells.
    """
    from distributed import Client, LocalCluster

    with ThreadPoolExecutor(1) as thread:
        with _without_ctrl_c():
            # No memory limit: near it dask pauses a worker for good, since a world's caches are
            # never freed.
            starting = thread.submit(
                LocalCluster,
                n_workers=jobs,
                processes=True,
                threads_per_worker=1,
                memory_limit=0,
                silence_logs=50,
                # Any free port: two runs on one machine would compete for dask's default port.
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
            )
        try:
            try:
                client = Client(starting.result())
            # dask's messages name no file; a configuration value may come from any of its files.
            except (OSError, RuntimeError, ValueError, TypeError, LookupError) as error:
                text = " ".join(str(error).split()) or type(error).__name__
                raise ClusterError(
                    f"the worker processes could not be started ({text}); run again, or with"
                    " --jobs 1"
                ) from None
            with _closed(client):
                yield client
        except BaseException:
            _kill_workers_until_done(starting)
            if not starting.exception():
                _kill_workers_until_done(thread.submit(starting.result().close))
            raise
        with contextlib.suppress(OSError, RuntimeError):
            starting.result().close()


def _kill_workers_until_done(end: concurrent.futures.Future[Any]) -> None:
    while not end.done():
        for process in multiprocessing.active_children():
            if process.name.startswith("Dask Worker"):
                process.kill()
        concurrent.futures.wait([end], timeout=0.1)


def run_on_scheduler(
    cells: list[Cell],
    store: Store,
    scenes: Mapping[str, Scene],
    scheduler: str,
    report: CellReporter,
    needs: Sequence[Path] = (),
) -> Generator[Ended]:
    """Compute cells on the workers of the user's scheduler, and write the records here; yield
    each as it ends, with its failure.

    Args:
        store: the run's folder; workers read it only if ``needs`` lists it.
        scenes: scenes by their names in cells.
        scheduler: address, such as ``tcp://host:8786``, or scheduler file.
        report: callback for each cell handed out, and for a line about each refused or lost
            worker.
        needs: paths that every worker must be able to read.

    Raises:
        ClusterError: the scheduler cannot be reached, or every worker is refused.
        ClusterLost: the connection to the scheduler broke.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(_silent())
        client = stack.enter_context(_closed(_connect(scheduler)))
        place = _Remote(store, scenes)
        yield from _Runner(client, cells, place, report, this_code(), needs).run()


def _connect(scheduler: str) -> Client:
    from distributed import Client
    from distributed.comm.registry import get_backend

    address = scheduler if "://" in scheduler else _address_in(Path(scheduler))
    try:
        get_backend(address.partition("://")[0])  # a Client of an unknown one cannot be closed
        return Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError, LookupError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise ClusterError(
            f"--scheduler: no scheduler at {address} ({text}); start one with: dask scheduler"
            " --host HOST"
        ) from None


def _address_in(file: Path) -> str:
    """Read the scheduler's address from its file."""
    try:
        return str(json.loads(file.read_bytes())["address"])
    except (OSError, ValueError, LookupError, TypeError):
        raise ClusterError(
            f"--scheduler: {str(file)!r} is neither an address such as tcp://host:8786 nor a"
            f" scheduler file; write one with: dask scheduler --scheduler-file {file}"
        ) from None


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep dask's log out of the command's output: its relevant failures become output lines.

    Raises:
        ClusterError: dask cannot read its configuration files or environment variables.
    """
    try:
        import distributed  # makes its loggers
    except ImportError:
        raise
    except Exception as error:
        raise ClusterError(
            f"dask cannot read its configuration ({' '.join(str(error).split())}); correct the"
            " file, in ~/.config/dask or where DASK_CONFIG says, or run with --jobs 1"
        ) from None
    names = [n for n in logging.root.manager.loggerDict if n.split(".")[0] == distributed.__name__]
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in names}
    try:
        for logger in levels:
            logger.setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


@contextlib.contextmanager
def _closed(resource: Any) -> Iterator[Any]:
    """Close a client or a cluster at the end.

    Errors at closing are dropped: every record is on disk by then, and such an error would
    hide the interrupt that ended the run.
    """
    try:
        yield resource
    finally:
        with contextlib.suppress(OSError, RuntimeError):
            resource.close()


@contextlib.contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Shield threads and workers started inside from Ctrl-C, which the main thread handles."""
    # Threads and processes inherit blocked signals. multiprocessing's tracker, started by the first
    # process, would unblock SIGINT.
    resource_tracker.ensure_running()
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


class _Runner:
    """Scheduler of cells on a cluster: each worker computes one cell at a time.

    A cell is bound to its worker. So a worker stays with the scene whose truth it has computed, a
    refused worker gets no cell, and a lost worker takes only its current cell with it.

    Args:
        place: transport of cells to the workers.
        report: callback for each cell handed out, and for lines about workers.
        code: code that a worker must have; None skips the check.
        needs: paths that every worker must be able to read.
    """

    def __init__(
        self,
        client: Client,
        cells: list[Cell],
        place: Workplace,
        report: CellReporter,
        code: Code | None = None,
        needs: Sequence[Path] = (),
    ) -> None:
        self.client = client
        self.needs = [str(path.resolve()) for path in needs]
        self.place = place
        self.report = report
        self.code = code
        self.cells = _Queue(cells)
        self.ended: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self.workers: dict[Any, str] = {}  # a task's key -> the address of its worker
        self.running: dict[str, tuple[Future, Cell]] = {}  # by the worker's address
        self.asked: dict[str, Future] = {}
        self.accepted: set[str] = set()
        self.refused: dict[str, str] = {}
        self.scene: dict[str, str] = {}
        self.lost: Counter[str] = Counter()
        self.requests: list[Future] = []

    def run(self) -> Iterator[Ended]:
        """Yield every cell as it ends."""
        looked = -POLL_SECONDS
        waiting_since = time.monotonic()
        while self.cells or self.running:
            if time.monotonic() - looked >= POLL_SECONDS:
                yield from self._look_at_workers()
                looked = time.monotonic()
                if self.accepted or not self.refused or self.asked:
                    waiting_since = looked
                elif looked - waiting_since > REFUSED_SECONDS:
                    raise ClusterError(
                        "--scheduler: every worker was refused: "
                        + "; ".join(sorted(self.refused.values()))
                    )
            self._hand_out()
            with contextlib.suppress(queue.Empty):
                yield from self._end(self.ended.get(timeout=POLL_SECONDS))
                while True:
                    yield from self._end(self.ended.get_nowait())

    def _look_at_workers(self) -> Iterator[Ended]:
        """Add new workers, and give up lost ones."""
        addresses = self._addresses()
        for worker in addresses - self.accepted - self.refused.keys() - self.asked.keys():
            if self.code is None:
                self.accepted.add(worker)
            else:
                question = self.client.submit(
                    code_of_worker, 0, self.needs, workers=[worker], pure=False
                )
                self.asked[worker] = self._watched(worker, question)
        for worker in (self.accepted | self.refused.keys() | self.asked.keys()) - addresses:
            yield from self._give_up(worker)

    def _addresses(self) -> set[str]:
        """Addresses of the scheduler's workers."""
        try:
            if self.client.status != "running":
                raise ClusterLost
            return set(self.client.nthreads())
        except (OSError, AttributeError, RuntimeError):  # AttributeError: no scheduler any more
            raise ClusterLost from None

    def _give_up(self, worker: str) -> Iterator[Ended]:
        """Give up a lost worker; its current cell is tried once more."""
        self.refused.pop(worker, None)
        self.asked.pop(worker, None)
        self.accepted.discard(worker)
        self.place.forget(worker)
        if worker not in self.running:
            return
        future, cell = self.running.pop(worker)
        future.cancel()
        self.lost[cell.id] += 1
        if self.lost[cell.id] < ATTEMPTS:
            self.report.report.log(
                f"worker {worker} was lost at {cell.title}; the cell is tried once more"
            )
            self.cells.put_back(cell)
        else:
            error = RuntimeError(
                f"{ATTEMPTS} workers were lost at this cell, the last at {worker}: killed from"
                " outside, or out of memory"
            )
            yield cell, failure(cell, error)

    def _hand_out(self) -> None:
        """Send a cell to each idle worker."""
        for worker in sorted(self.accepted - self.running.keys()):
            busy = {cell.probe for _, cell in self.running.values()}
            cell = self.cells.take(self.scene.get(worker), busy)
            if cell is None:
                break
            self.scene[worker] = cell.scene
            self.report.start(cell)
            future = self.place.submit(self.client, worker, cell)
            self.running[worker] = (self._watched(worker, future), cell)
        if self.place.adaptive:
            self._request_workers()

    def _request_workers(self) -> None:
        """Request as many workers of an adaptive cluster as cells wait.

        The scheduler does not know the cells that wait here. So as many tasks wait there, for a
        resource that no worker offers.
        """
        wanted = min(len(self.cells), MOST_REQUESTS)
        missing = wanted - len(self.requests)
        if missing > 0:
            self.requests += self.client.map(
                code_of_worker,
                [*range(missing)],
                key="attnwarp-cells-that-wait",
                resources={"attnwarp: only counted": 1},
                pure=False,
            )
        elif -missing > wanted // 10:  # seldom, since each change waits for the scheduler
            self.client.cancel(self.requests[wanted:])
            del self.requests[wanted:]

    def _watched(self, worker: str, future: Future) -> Future:
        self.workers[future.key] = worker
        future.add_done_callback(self.ended.put)
        return future

    def _end(self, future: Future) -> Iterator[Ended]:
        """Process a finished future: a cell's result, or a worker's code."""
        from distributed.scheduler import KilledWorker

        worker = self.workers.pop(future.key)
        if self.asked.get(worker) is future:
            self._judge(worker, future)
            del self.asked[worker]
            return
        running, cell = self.running.get(worker, (None, None))
        if running is not future or cell is None:
            return  # given up before
        try:
            result = self._result(worker, future)
        except ClusterLost:
            raise
        except KilledWorker:  # from a scheduler that gives up a task at the first lost worker
            yield from self._give_up(worker)
            return
        except Exception as error:
            del self.running[worker]
            yield cell, failure(cell, error)
            return
        if result is not None:
            del self.running[worker]
            yield cell, self.place.receive(cell, result[0])

    def _result(self, worker: str, future: Future) -> tuple[Any] | None:
        """Result of a future; None if its worker is lost before the result is fetched.

        Until then the result is only on its worker.
        """
        while True:
            if future.status == "cancelled":
                raise ClusterLost
            try:
                return (future.result(timeout=10),)
            except TimeoutError:
                if future.status == "error":
                    raise
                if worker not in self._addresses():
                    return None

    def _judge(self, worker: str, future: Future) -> None:
        """Accept a worker that has this code and can read the needed paths, refuse any other."""
        assert self.code is not None
        try:
            result = self._result(worker, future)
        except ClusterLost:
            raise
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            difference = f"it cannot load this version of attnwarp ({text})"
            name = worker
        else:
            if result is None:
                return
            code = result[0]
            difference = code.difference(self.code)
            name = f"{code.worker} ({worker})" if code.worker != worker else worker
        if difference:
            self.refused[worker] = f"worker {name}: {difference}"
            self.report.report.log(f"worker {name} is refused: {difference}")
        else:
            self.accepted.add(worker)


class _Queue:
    """Cells by scene. A worker stays with its scene, then helps where most is left."""

    def __init__(self, cells: list[Cell]) -> None:
        self.scenes: dict[str, deque[Cell]] = {}
        for cell in cells:
            self.scenes.setdefault(cell.scene, deque()).append(cell)
        self.started: set[str] = set()
        self.count = len(cells)

    def __len__(self) -> int:
        return self.count

    def put_back(self, cell: Cell) -> None:
        """Put a cell back as the first of its scene."""
        self.scenes.setdefault(cell.scene, deque()).appendleft(cell)
        self.count += 1

    def take(self, scene: str | None, busy: Collection[str] = ()) -> Cell | None:
        """The next cell for a worker; None when nothing is left.

        Args:
            scene: scene of the cell that the worker computed last; None if it is its first.
            busy: probes of the running cells. A first cell is of another probe if possible: kernels
                that one worker compiles are then on disk when the other needs them.
        """
        if not self.count:
            return None
        new = scene is None
        if scene is None or not self.scenes.get(scene):
            left = {name: cells for name, cells in self.scenes.items() if cells}
            scene = max(left, key=lambda name: (name not in self.started, len(left[name])))
        self.started.add(scene)
        self.count -= 1
        cells = self.scenes[scene]
        others = (k for k, cell in enumerate(cells) if cell.probe not in busy)
        index = next(others, 0) if new else 0
        cell = cells[index]
        del cells[index]
        return cell
