"""Whether the scene's drives take what a recording commanded, before any computing.

An effort that the equations of motion use and the simulation does not makes every
verdict wrong: an effect mends the equations, and the simulation stays as far off.
"""

from collections.abc import Sequence

from pydrake.multibody.plant import MultibodyPlant

from makebreak.gap.data.findings import Finding
from makebreak.gap.data.recording import Recording
from makebreak.models.model_files import couplings_of
from makebreak.models.scene import ActuationSection, Scene, initial_for
from makebreak.models.scene_schema import COMMANDS_OF
from makebreak.models.typed_yaml import nearest

_NAMED = 3  # Columns that a message lists before it counts.


def check_drives(recording: Recording, scene: Scene) -> None:
    """Refuses commands that the scene's actuation does not take, and measured efforts
    that would stand in for commands where the scene drives nothing by effort.

    Raises: ValueError, with the actuation that the scene needs, to be pasted.
    """
    act = scene.actuation
    takes = COMMANDS_OF[act.type]
    lost = [
        c.name
        for c in recording.commands()
        if c.quantity not in takes or c.at not in act.joints
    ]
    commanded = {c.at for c in recording.commands()}
    by_effort = act.joints if "effort_command" in takes else []
    stand_ins = [
        c.name
        for c in recording.measured()
        if c.quantity == "effort_measured"
        and c.at not in commanded
        and c.at not in by_effort
        and f"{c.at}.position" in recording
    ]
    if not lost and not stand_ins:
        return
    every = [c.name for c in recording.commands()] + stand_ins
    says = _listed(lost or stand_ins)
    if lost:
        says += f": the scene's {_words(act)} not take that"
    else:
        says += f": no command was recorded there, and the scene's {_words(act)} not "
        says += "take the measured effort in its place"
    proposal = _proposal(every, act)
    raise ValueError(
        f"recording {recording.path}: {says}; add to the scene: {proposal}; "
        "or leave the columns out: map them to null under `columns` in "
        f"{recording.path.with_suffix('.yaml').name}"
    )


def untold_joints(scene: Scene, recordings: Sequence[Recording]) -> list[str]:
    """Joints that the scene drives by efforts, and of which a recording has neither a
    command nor a measured effort, as it has of others: what drives them is not known.
    (Where it has none at all, no torque acts.)"""
    if "effort_command" not in COMMANDS_OF[scene.actuation.type]:
        return []
    told = ("effort_command", "effort_measured")
    joints = scene.actuation.joints
    untold = [
        joint
        for joint in joints
        if any(not any(f"{joint}.{what}" in r for what in told) for r in recordings)
    ]
    return untold if len(untold) < len(joints) else []


def check_untold(scene: Scene, recordings: Sequence[Recording]) -> list[Finding]:
    """What is done about joints whose efforts are not recorded."""
    joints = untold_joints(scene, recordings)
    if not joints:
        return []
    own, it = "their own equations are", "they move"
    are = "are"
    if len(joints) == 1:
        own, it, are = "its own equation is", "it moves", "is"
    says = (
        f"{', '.join(joints)} {are} driven (actuation of the scene), and no column "
        f"says by what: {own} left out, and in simulation {it} as measured. If nothing "
        f"drives {'it' if are == 'is' else 'them'}, change the scene's actuation; "
        "else record the effort."
    )
    return [Finding("untold_effort", recordings[0].name, joints[0], len(joints), "",
                    "warning", says)]  # fmt: skip


def check_couplings(scene: Scene, plant: MultibodyPlant) -> None:
    """Raises: ValueError if the models tie joints or bodies together (a mimic, a closed
    loop): forces of constraints are in no equation here."""
    if not plant.num_constraints():
        return
    pairs = couplings_of(scene)
    joints = dict.fromkeys(each for pair in pairs.items() for each in pair)
    says = f"the scene's models have {plant.num_constraints()} constraints"
    if pairs:
        says += f" ({', '.join(f'{a} follows {b}' for a, b in pairs.items())})"
    says += ", which equations of motion lack"
    if joints:
        where = ", ".join(f"{name}: 0" for name in joints)
        says += (
            f"; where they hardly move, add to the scene: fixed_joints: {{{where}}}, "
            "with their positions, and map their columns to null"
        )
    raise ValueError(says)


def check_initial_names(scene: Scene, recordings: Sequence[Recording]) -> None:
    """Raises: ValueError if `initial` names recordings, and none of these."""
    if not scene.initial_of:
        return
    for recording in recordings:
        for episode in recording.episodes:
            found = initial_for(scene, str(recording.path), episode.number)
            if found is not scene.initial:
                return
    name = recordings[0].path.name
    raise ValueError(
        f"the scene's `initial` is of {', '.join(scene.initial_of)}, and nothing of it "
        f"of {name}; {nearest(name, scene.initial_of)}"
    )


def _words(act: ActuationSection) -> str:
    if act.type == "none":
        return "actuation is of type none and does"
    return f"actuation (type {act.type}, joints {', '.join(act.joints)}) does"


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    tail = f" and {more} more" if more > 0 else ""
    return f"column{'s' * (len(names) > 1)} {', '.join(names[:_NAMED])}{tail}"


def _proposal(channels: Sequence[str], act: ActuationSection) -> str:
    """The section to be pasted: for what was recorded, and the joints of both."""
    quantities = {name.rsplit(".", 1)[1] for name in channels}
    if quantities & {"effort_command", "effort_measured"}:
        wanted = {"effort_command", "effort_measured"}
        kind, gains = "effort", ""
    elif {"position_command", "velocity_command"} <= quantities:
        wanted = {"position_command", "velocity_command"}
        kind, gains = "pd", ", kp: [KP], kd: [KD]"
    elif "position_command" in quantities:
        wanted = {"position_command"}
        kind, gains = "servo", ", kp: [KP], kd: [KD]"
    else:
        wanted = {"velocity_command"}
        kind, gains = "velocity", ", kd: [KD]"
    of = [name.rsplit(".", 1) for name in channels]
    joints = [at for at, quantity in of if quantity in wanted]
    if act.type == kind:
        joints = [*act.joints, *joints]
    listed = ", ".join(dict.fromkeys(joints))
    said = f"`actuation: {{type: {kind}, joints: [{listed}]{gains}}}`"
    return said + (" with the drives' own gains as KP and KD" if gains else "")
