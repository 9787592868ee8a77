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

from typing import TYPE_CHECKING

from makebreak.lazy import offered

# What users import; imported when asked for, so that a part of it does not wait for
# the whole.
if TYPE_CHECKING:
    from makebreak.gap.data.reading import (
        read_recording as read_recording,
        read_recordings as read_recordings,
    )
    from makebreak.gap.data.recording import Recording as Recording
    from makebreak.gap.data.table import write_recording as write_recording
    from makebreak.gap.design import LogDesign as LogDesign, LogPlan as LogPlan
    from makebreak.gap.report.files import write_report as write_report
    from makebreak.gap.result import GapResult as GapResult
    from makebreak.gap.workflow import run_gap as run_gap
    from makebreak.models.scene import read_scene as read_scene
else:
    __getattr__, __dir__, __all__ = offered(__name__)
