"""What `reproduce` makes: a paper's figures or goals beside ours, row by row."""

from collections.abc import Mapping, Sequence

from makebreak.scripts.session import Session
from makebreak.scripts.table import Table
from makebreak.scripts.trials import run_many, setting_texts


class Rows:
    """Rows of a table. Args: command: of a row that names none."""

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
        """Args: good: whether a stated target is met; None: there is none."""
        self.rows.append(
            (what, paper, ours, self.command if command is None else command)
        )
        self.met.append(None if good is None else bool(good))

    def to_table(self, title: str, notes: Sequence[str] = (), theirs="paper") -> Table:
        """Args: theirs: the head of what ours is compared with."""
        columns = ("what", theirs, "ours", "command")
        return Table(title, columns, self.rows, self.met, notes)


class Comparison(Rows):
    """Trials of one experiment, and the rows that are made of them.

    Args: experiment: its name. session: whose folder the trials go to. jobs: how many
        run at once. command: of a row that names none; None: a run of the experiment.
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
        """{name: runs(settings, seeds)} of {name: settings}, side by side."""
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
        """The command of a run with settings, as one types it."""
        words = " ".join(setting_texts(settings)).replace(", ", ",")
        return f"{self.command} --set {words}" if words else self.command
