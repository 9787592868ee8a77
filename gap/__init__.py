"""The gap workflow: where a simulation and measured data disagree, and why.

data/        recordings: read, checked, conditioned, split
simulation/  scenes simulated from measured states
residuals/   kinds of data, each as a problem (problem.py) for the search
search/      which effects a scene lacks
report/      files and pictures
fit.py       effects fitted together to a problem
workflow.py  from a scene and recordings to a result

from makebreak.gap import read_scene, run_gap, write_report

result = run_gap("scene.yaml", ["log.csv"])
print(result.verdict, [each.kind for each in result.effects])
write_report(result, read_scene("scene.yaml"), "report")
"""

from importlib import import_module

# What users import, and where it is; imported when asked for, so that a part of it
# does not wait for the whole.
_EXPORTS = {
    "GapResult": "gap.result",
    "Recording": "gap.data.recording",
    "read_recording": "gap.data.reading",
    "read_recordings": "gap.data.reading",
    "read_scene": "models.scene",
    "run_gap": "gap.workflow",
    "write_recording": "gap.data.table",
    "write_report": "gap.report.files",
}
__all__ = list(_EXPORTS)


def __getattr__(name: str):
    if name not in _EXPORTS:
        raise AttributeError(f"module 'makebreak.gap' has no attribute {name!r}")
    return getattr(import_module(f"makebreak.{_EXPORTS[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_EXPORTS]
