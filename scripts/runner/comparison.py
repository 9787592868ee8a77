"""Tables of `reproduce`: results of a paper, or goals, beside ours."""

from collections.abc import Mapping, Sequence

from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.table import Table
from makebreak.scripts.runner.trials import run_many, setting_texts


class Rows:
    """Collects the rows of a table. Args: command: default of the column `command`."""

    def __init__(self, command: str):
        self.command = command
        self.rows: list[tuple] = []
        self.met: list[bool | None] = []

    def row(
        self,
        what: str,
        paper: str,
        ours,
        good: bool | None = None,
        command: str | None = None,
    ) -> None:
        """Adds a row. Args: good: whether its target is met; None without target."""
        self.rows.append(
            (what, paper, ours, self.command if command is None else command)
        )
        self.met.append(None if good is None else bool(good))

    def to_table(self, title: str, notes: Sequence[str] = (), theirs="paper") -> Table:
        """Args: theirs: heading of the column that ours is compared with."""
        columns = ("what", theirs, "ours", "command")
        return Table(title, columns, self.rows, self.met, notes)


class Comparison(Rows):
    """Runs trials of one experiment, and collects rows made of their results.

    Args: experiment: its name; session: its folder takes the trials; jobs: number of
        parallel processes; command: default of the column `command`, None for a run of
        the experiment.
    """

    def __init__(
        self, experiment: str, session: Session, jobs: int, command: str | None = None
    ):
        super().__init__(command or f"makebreak run {experiment} --seed S")
        self.experiment, self.session, self.jobs = experiment, session, jobs

    def runs(self, settings: Mapping, seeds: int) -> list[dict]:
        """The results of seeds 0 .. seeds - 1, as run_many gives them."""
        return self.runs_of({"": settings}, seeds)[""]

    def runs_of(self, variants: Mapping[str, Mapping], seeds: int) -> dict:
        """{name: runs(settings, seeds)} of {name: settings}, all in parallel."""
        trials = [(s, seed) for s in variants.values() for seed in range(seeds)]
        results = run_many(
            self.experiment, trials, self.jobs, self.session.out_dir,
            reuse=self.session.reuse,
        )  # fmt: skip
        return {
            name: results[i * seeds : (i + 1) * seeds]
            for i, name in enumerate(variants)
        }

    def with_settings(self, settings: Mapping) -> str:
        """The command line of a run with these settings."""
        words = " ".join(setting_texts(settings)).replace(", ", ",")
        return f"{self.command} --set {words}" if words else self.command
