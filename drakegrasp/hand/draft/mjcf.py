"""MJCF as Drake reads it.

In: the XML of an MJCF file. Out: the same hand without the parts of the language that Drake drops:
bodies and joints without names, frames, classes within classes.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

from drakegrasp.errors import HandError

#: Attributes that a class of MJCF gives to the elements of each tag.
_Defaults = dict[str, dict[str, str]]
#: Sections that say nothing of a hand.
_ASIDE = ("size", "keyframe", "sensor", "visual", "statistic", "custom", "deformable")
#: What makes bodies that the file does not write out.
_MADE = ("replicate", "composite", "flexcomp", "attach", "model")


def trim(root: Element) -> None:
    """Leave out what says nothing of a hand, and name each body and joint.

    Raises:
        HandError: If bodies are not written out.
    """
    for element in root.iter():
        if element.tag in _MADE:
            raise HandError(
                f"model: must have its bodies written out, got <{element.tag}>: load and save it "
                "with MuJoCo"
            )
    for section in [child for child in root if child.tag in _ASIDE]:
        root.remove(section)
    for material in root.iter("material"):
        for layer in material.findall("layer"):
            material.remove(layer)
    for world in root.findall("worldbody"):
        _name(world, "world", [0])


def _name(parent: Element, name: str, count: list[int]) -> None:
    """Give names to the bodies and joints below an element of a body of this name."""
    for child in parent:
        if child.tag == "frame":
            _name(child, name, count)
        elif child.tag == "body":
            count[0] += 1
            own = child.attrib.setdefault("name", f"body{count[0]}")
            joints = [joint for joint in child.iterfind("joint") if not joint.get("name")]
            for n, joint in enumerate(joints):
                joint.set("name", f"{name}-{own}" + (f"-{n + 1}" if n else ""))
            _name(child, own, count)


def spell_out(root: Element) -> None:
    """Replace frames by bodies that are welded, and write into each class what it inherits.

    Raises:
        HandError: If a frame holds a joint or an inertia of the body around it.
    """
    for world in root.findall("worldbody"):
        _lift_frames(world)
    for frame in root.iter("frame"):
        if spoilt := [c.tag for c in frame if c.tag in ("joint", "freejoint", "inertial")]:
            raise HandError(f"model: <{spoilt[0]}> must lie in a body, got it in a <frame>")
    for n, frame in enumerate(list(root.iter("frame"))):
        frame.tag = "body"
        frame.set("name", f"drakegrasp_frame_{n}")
    main: _Defaults = {}
    for default in root.findall("default"):
        main = _inherit(default, main)


def _lift_frames(world: Element) -> None:
    """Put what frames of the world hold into the world: the hand hangs free, wherever it is."""
    while (frame := world.find("frame")) is not None:
        place = list(world).index(frame)
        for child in frame:
            if "childclass" in frame.attrib and child.tag in ("body", "frame"):
                child.attrib.setdefault("childclass", frame.attrib["childclass"])
        world.remove(frame)
        world[place:place] = list(frame)


def _inherit(default: Element, above: _Defaults) -> _Defaults:
    """Write what a class of MJCF has from the classes around it into it; return what it gives.

    Drake looks only as far as the next class: what that one does not name would be lost.
    """
    given = {tag: dict(attributes) for tag, attributes in above.items()}
    own = [element for element in default if element.tag != "default"]
    for element in own:
        given.setdefault(element.tag, {}).update(element.attrib)
        element.attrib.update(given[element.tag])
    present = {element.tag for element in own}
    default.extend(Element(tag, given[tag]) for tag in given if tag not in present)
    for nested in default.findall("default"):
        _inherit(nested, given)
    return given
