"""A pushed object alone on its table: no arm, no actuation."""

from makebreak.models.model_files import MODELS
from makebreak.models.pushed_object import object_file
from makebreak.models.scene import Scene, read_scene


def object_alone(spec) -> Scene:
    """The scene of push_object with nothing but its table and the object of a spec."""
    scene = read_scene(MODELS / "push_object.scene.yaml")
    own = ("table", "object")
    scene.directives = [
        d for d in scene.directives
        if (d.add_model is not None and d.add_model.name in own)
        or (d.add_weld is not None and d.add_weld.child == "table::table")
    ]  # fmt: skip
    for d in scene.directives:
        if d.add_model is not None and d.add_model.name == "object":
            d.add_model.file = f"file://{object_file(spec)}"
    scene.actuation.type, scene.actuation.joints = "none", []
    return scene
