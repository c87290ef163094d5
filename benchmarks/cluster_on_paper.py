"""Estimate how long many rooms would take on a cluster, from the record of one room.

    python benchmarks/cluster_on_paper.py RUN --rooms 200 --points-m 48 --photos 40 \\
        --measured-points-m 16 --measured-photos 6 --workers 1 16 256

Each step of the record becomes one task per room. Its time and the size of its products grow with
the number of photos if photos or layers are among its inputs, otherwise with the number of points.
It reads all products that the preceding steps stored. A worker is a machine like the measured one
and runs one task at a time. Workers that transfer data share the bandwidth of the server, and none
exceeds the bandwidth of its own link. Ready tasks run in the order of the rooms.
"""

from __future__ import annotations

import argparse
import heapq
from collections import defaultdict
from dataclasses import dataclass, field

from orthoflow.records.open import open_run

# Overhead of a task, as measured by `benchmarks/many_cells.py`.
_TASK_S = 0.25
_NOTHING_MB = 1e-6


@dataclass(frozen=True)
class Task:
    """A step of every room.

    Attributes:
        address: address of its cell.
        seconds: duration, including its start.
        read_mb: data read from the server.
        written_mb: data written to the server.
        needs: addresses of the tasks on which it depends.
    """

    address: str
    seconds: float
    read_mb: float
    written_mb: float
    needs: tuple[str, ...]


@dataclass
class Simulated:
    """Result of a simulation.

    Attributes:
        hours: time until the last task has ended.
        busy: share of the workers' time in which they compute.
        server: share of the time in which the server is saturated.
        moved_tb: data moved over the network.
    """

    hours: float
    busy: float
    server: float
    moved_tb: float


def tasks_of(run: str, points: float, photos: float, cores: float | None = None) -> list[Task]:
    """Return the tasks of one room, with times and sizes scaled to its numbers of points or photos.

    If the record was made under other load, processor seconds divided by `cores` are used.
    """
    stored: dict[str, float] = {}
    found: list[Task] = []
    made: set[str] = set()
    for cell in open_run(run).record.cells:
        needs = tuple(
            dict.fromkeys(
                product.source.rpartition(".")[0]
                for product in cell.inputs.values()
                if not product.source.startswith("inputs.")
            )
        )
        factor = photos if {"photos", "layers"} & set(cell.inputs) else points
        stored[cell.address] = (cell.stored_mib or 0.0) * 1.048576 * factor
        if cell.method.startswith("simulate.") or cell.status != "ok":
            continue
        seconds = (cell.wall_s or 0.0) if cores is None else (cell.cpu_s or 0.0) / cores
        task = Task(
            address=cell.address,
            seconds=seconds * factor + _TASK_S,
            read_mb=sum(stored.get(name, 0.0) for name in needs),
            written_mb=stored[cell.address],
            needs=tuple(name for name in needs if name in made),
        )
        made.add(task.address)
        found.append(task)
    return found


@dataclass
class Cluster:
    """Workers that run the tasks of many rooms, and a server that they share.

    Attributes:
        tasks: tasks of one room, each after those on which it depends.
        n_rooms: number of rooms.
        n_free: number of workers without a task.
        server_mb_s: bandwidth of the server.
        link_mb_s: bandwidth of a worker's own link.
    """

    tasks: list[Task]
    n_rooms: int
    n_free: int
    server_mb_s: float
    link_mb_s: float
    _clock: float = 0.0
    _work_s: float = 0.0
    _saturated_s: float = 0.0
    # Remaining MB, by room, position of the task, and whether it reads.
    _transfers: dict[tuple[int, int, bool], float] = field(default_factory=dict)
    # End time, room, and position of the task.
    _computing: list[tuple[float, int, int]] = field(default_factory=list)

    def run(self) -> Simulated:
        """Run all rooms, event by event."""
        n_workers, place = self.n_free, {task.address: i for i, task in enumerate(self.tasks)}
        followers: dict[int, list[int]] = defaultdict(list)
        for task in self.tasks:
            for need in task.needs:
                followers[place[need]].append(place[task.address])
        n_needed = [[len(task.needs) for task in self.tasks] for _ in range(self.n_rooms)]
        ready = [
            (room, i) for room in range(self.n_rooms) for i, n in enumerate(n_needed[0]) if not n
        ]
        while ready or self._transfers or self._computing:
            while ready and self.n_free:
                room, index = heapq.heappop(ready)
                self.n_free -= 1
                self._transfers[room, index, True] = self.tasks[index].read_mb
            for room, index in self._next_ends():
                self.n_free += 1
                for follower in followers[index]:
                    n_needed[room][follower] -= 1
                    if not n_needed[room][follower]:
                        heapq.heappush(ready, (room, follower))
        moved_mb = self.n_rooms * sum(task.read_mb + task.written_mb for task in self.tasks)
        return Simulated(
            hours=self._clock / 3600,
            busy=self._work_s / (n_workers * self._clock),
            server=self._saturated_s / self._clock,
            moved_tb=moved_mb / 1e6,
        )

    def _next_ends(self) -> list[tuple[int, int]]:
        """Advance to the next event; return the tasks that end with it."""
        rate = min(self.link_mb_s, self.server_mb_s / max(1, len(self._transfers)))
        steps = [left / rate for left in self._transfers.values()]
        steps += [end - self._clock for end, _, _ in self._computing[:1]]
        step = max(0.0, min(steps))
        self._clock += step
        self._saturated_s += step * (len(self._transfers) * self.link_mb_s >= self.server_mb_s)
        ended = []
        for transfer, left in tuple(self._transfers.items()):
            self._transfers[transfer] = left - rate * step
            if self._transfers[transfer] > _NOTHING_MB:
                continue
            del self._transfers[transfer]
            room, index, is_reading = transfer
            if is_reading:
                seconds = self.tasks[index].seconds
                self._work_s += seconds
                heapq.heappush(self._computing, (self._clock + seconds, room, index))
            else:
                ended.append((room, index))
        while self._computing and self._computing[0][0] <= self._clock:
            _, room, index = heapq.heappop(self._computing)
            self._transfers[room, index, False] = self.tasks[index].written_mb
        return ended


def main() -> None:
    """Print a line for each number of workers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run")
    parser.add_argument("--rooms", type=int, default=200)
    parser.add_argument("--points-m", type=float, default=48.0)
    parser.add_argument("--photos", type=float, default=40.0)
    parser.add_argument("--measured-points-m", type=float, required=True)
    parser.add_argument("--measured-photos", type=float, required=True)
    parser.add_argument("--cores", type=float, help="share processor seconds; else wall time")
    parser.add_argument("--server-mb-s", type=float, default=1000.0)
    parser.add_argument("--link-mb-s", type=float, default=110.0)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 16, 256])
    wanted = parser.parse_args()
    tasks = tasks_of(
        wanted.run,
        wanted.points_m / wanted.measured_points_m,
        wanted.photos / wanted.measured_photos,
        wanted.cores,
    )
    longest = max(tasks, key=lambda task: task.seconds)
    print(
        f"a room: {len(tasks)} tasks, {sum(task.seconds for task in tasks) / 60:.0f} min of work; "
        f"the longest, {longest.address}, {longest.seconds / 60:.0f} min"
    )
    for n_workers in wanted.workers:
        found = Cluster(tasks, wanted.rooms, n_workers, wanted.server_mb_s, wanted.link_mb_s).run()
        print(
            f"{n_workers:4} workers: {found.hours:8.1f} h, {found.moved_tb:6.2f} TB moved, workers "
            f"compute {found.busy:.0%} of the time, the server is saturated {found.server:.0%}"
        )


if __name__ == "__main__":
    main()
