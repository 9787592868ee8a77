"""How long simulations and the systems in them took: timing.json."""

import numpy as np
from pydrake.systems.framework import Diagram, System

from makebreak.systems.numerics.timing import UpdateTimes


def leaf_systems(system: System):
    """All leaf systems of a diagram, those of nested diagrams too."""
    if isinstance(system, Diagram):
        for child in system.GetSystems():
            yield from leaf_systems(child)
    else:
        yield system


class RunTiming:
    """Times of one or several simulations of a run; len() is how many."""

    def __init__(self):
        self._entries: dict[str, dict] = {}

    def __len__(self) -> int:
        return len(self._entries)

    def clear(self) -> None:
        """Discards all simulations."""
        self._entries.clear()

    @staticmethod
    def start(diagram: Diagram) -> None:
        """Forgets what the diagram's systems took before."""
        for system in leaf_systems(diagram):
            if hasattr(system, "update_times"):
                system.update_times = UpdateTimes()

    def note(
        self, label: str, diagram: Diagram, simulated: float, wall: float, cpu: float
    ) -> None:
        """Notes one simulation.

        Args: label: its name among several. simulated: seconds of its time; wall, cpu:
            seconds of the clock and of the process that it took.
        """
        entry: dict = {
            "simulated_s": simulated,
            "wall_s": wall,
            "cpu_s": cpu,
            "real_time_factor": simulated / wall,
            "systems": {},
        }
        for system in leaf_systems(diagram):
            times = getattr(system, "update_times", None)
            if times is not None and times.updates:
                name = system.get_name()  # Unique in one diagram, not in nested ones.
                if name in entry["systems"]:
                    name = system.GetSystemPathname()
                ms, cpu_ms = 1e3 * np.array([times.wall_sec, times.cpu_sec])
                period_ms = 1e3 * simulated / times.updates
                entry["systems"][name] = {
                    "updates": times.updates,
                    "timed": len(ms),  # Some of them, see timing.py.
                    "period_ms": period_ms,
                    "p50_ms": float(np.percentile(ms, 50)),
                    "p99_ms": float(np.percentile(ms, 99)),
                    "max_ms": float(ms.max()),
                    "overruns": int((ms > period_ms).sum()),
                    "cpu_p50_ms": float(np.percentile(cpu_ms, 50)),
                    "cpu_p99_ms": float(np.percentile(cpu_ms, 99)),
                    "cpu_overruns": int((cpu_ms > period_ms).sum()),
                }
        self._entries[label] = entry

    def too_slow(self) -> list[str]:
        """A line for each system that would not keep real time on this machine: more
        than one update in a hundred took more CPU time than its period."""
        lines = {}
        for entry in self._entries.values():
            for name, system in entry["systems"].items():
                if system["cpu_p99_ms"] > system["period_ms"]:
                    lines[name] = (
                        f"Too slow for real time: {name}, {system['cpu_overruns']} of "
                        f"{system['timed']} updates took more CPU time than its "
                        f"period of {system['period_ms']:.3g} ms "
                        f"(99 %: {system['cpu_p99_ms']:.3g})"
                    )
        return list(lines.values())

    def summary(self) -> dict:
        """Sums over the whole run, and figures of each simulation if there were more
        than one."""
        entries = list(self._entries.values())
        total = {
            key: sum(e[key] for e in entries)
            for key in ("simulated_s", "wall_s", "cpu_s")
        }
        summary = {"real_time_factor": total["simulated_s"] / total["wall_s"]}
        summary["real_time_factor_cpu"] = total["simulated_s"] / total["cpu_s"]
        summary |= total
        if len(entries) == 1:
            return summary | {"systems": entries[0]["systems"]}
        return summary | {"simulations": self._entries}
