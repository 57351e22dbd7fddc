"""Reader of the tag files of apriltag_ros: bundles with poses and sizes (ROS 1), and settings with sizes (ROS 2).

Tag frame of apriltag_ros: x to the right and y up in the printed image, z out of the printed side, as ours;
`size` is the edge of the black border. The poses of a bundle are in the frame of the bundle.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.core.rotations import quat_multiply, quat_rotate
from finssim.core.yaml_file import read_mapping
from finssim.vehicles.part import VehicleError, did_you_mean

__all__ = ["LaidTag", "TagLayout", "read_tag_layout", "with_layout"]

OF_BUNDLE = {"id", "size", "x", "y", "z", "qw", "qx", "qy", "qz"}
"""Keys of a tag in a bundle."""
OF_ROS_1 = {
    "standalone_tags", "tag_bundles", "tag_family", "tag_threads", "tag_decimate", "tag_blur", "tag_refine_edges",
    "tag_debug", "max_hamming_dist", "publish_tf", "transport_hint", "remove_duplicates",
}  # fmt: skip
"""Keys of tags.yaml and settings.yaml of ROS 1."""
OF_ROS_2 = {
    "family", "size", "tag", "image_transport", "max_hamming", "profile", "pose_estimation_method", "z_up", "detector",
    "qos_overrides", "use_sim_time", "publish_tf",
}  # fmt: skip
"""Keys of the parameters of ROS 2."""
PARAMETERS = "ros__parameters"
"""Key of parameters in a file of ROS 2."""


class LaidTag(NamedTuple):
    """Pose of a tag in a bundle."""

    position: NDArray[np.float64]
    """Centre in the frame of the bundle [m], (3,)."""
    orientation: NDArray[np.float64]
    """Tag frame to frame of the bundle, xyzw, (4,)."""


@dataclass(frozen=True)
class TagLayout:
    """Content of a tag file."""

    sizes: Mapping[int, float]
    """Edge of each tag's black border by id [m]."""
    poses: Mapping[int, LaidTag] = field(default_factory=dict)
    """Pose of each tag by id; empty if the file contains only sizes."""
    family: str = ""
    """Family of the tags; empty if the file contains none."""
    remarks: tuple[str, ...] = ()
    """Sentences about contents that were not read."""


def read_tag_layout(path: Path) -> TagLayout:
    """Read a tag file of apriltag_ros.

    Raises:
        VehicleError: The file cannot be read, or contains an unknown key, several bundles, or an invalid number.
    """
    tree = read_mapping(
        path, VehicleError, such_as="tag_bundles: [{name: top, layout: [{id: 1, size: 0.08}]}]"
    )
    inner: Any = tree
    for _ in range(3):  # parameters may be nested under a namespace and a node name
        if isinstance(inner, Mapping) and PARAMETERS in inner:
            return _ros_2(_mapping(inner[PARAMETERS], f"{path}: {PARAMETERS}"), path)
        values = list(inner.values()) if isinstance(inner, Mapping) else []
        inner = values[0] if len(values) == 1 else None
    return _ros_1(tree, path)


def with_layout(tags: Mapping[str, Any], folder: Path, label: str) -> dict[str, Any]:
    """Return the section `tags` of a vehicle file with its key `layout` replaced by the tags of that file.

    A bundle becomes `mounts`: `position` and `orientation` are the pose of its frame in the body frame. Sizes
    without poses are assigned to the section's own `mounts`.

    Args:
        tags: The section.
        folder: Folder of the vehicle file.
        label: Name of the vehicle file in messages.

    Raises:
        VehicleError: The file cannot be read, or does not match the section.
    """
    section = dict(tags)
    layout = read_tag_layout(folder / str(section.pop("layout")))
    family = section.setdefault("family", layout.family)
    if not family:
        raise VehicleError(
            f"{label}: tags.family is missing, and its layout names none: add it, such as family: tag36h11"
        )
    if not layout.poses and not isinstance(section.get("mounts"), Mapping):
        raise VehicleError(
            f"{label}: tags.layout gives sizes of tags {_named(layout.sizes)} without poses: add mounts with a "
            "position for each"
        )
    if layout.poses:
        if "mounts" in section:
            raise VehicleError(f"{label}: tags.layout and tags.mounts both give poses: keep one of them")
        position = _numbers(section.pop("position", (0.0, 0.0, 0.0)), 3, f"{label}: tags.position")
        turn = _unit(section.pop("orientation", (0.0, 0.0, 0.0, 1.0)), f"{label}: tags.orientation")
        section["mounts"] = {
            tag: {
                "position": (position + quat_rotate(turn, pose.position)).tolist(),
                "orientation": quat_multiply(turn, pose.orientation).tolist(),
            }
            for tag, pose in layout.poses.items()
        }
    mounts = {
        tag: dict(_mapping(mount, f"{label}: tags.mounts.{tag}")) for tag, mount in section["mounts"].items()
    }
    sizes = {
        tag: layout.sizes[int(tag)] for tag in mounts if str(tag).isdecimal() and int(tag) in layout.sizes
    }
    if not sizes:
        raise VehicleError(
            f"{label}: tags.layout has tags {_named(layout.sizes)}, and tags.mounts none of them: correct their ids"
        )
    edge = section.setdefault("edge", Counter(sizes.values()).most_common(1)[0][0])
    for tag, size in sizes.items():
        if size != edge:
            mounts[tag]["edge"] = size
    return section | {"mounts": mounts}


def _ros_1(tree: Mapping[Any, Any], path: Path) -> TagLayout:
    _refuse_unknown(tree, OF_ROS_1, str(path))
    sizes: dict[int, float] = {}
    alone = []
    for number, entry in enumerate(_list(tree.get("standalone_tags") or [], f"{path}: standalone_tags"), 1):
        where = f"{path}: standalone tag {number}"
        values = _mapping(entry, where)
        _refuse_unknown(values, {"id", "size", "name"}, where)
        tag = _id(values, where)
        sizes[tag] = _size(values, where)
        alone.append(tag)
    bundles = _list(tree.get("tag_bundles") or [], f"{path}: tag_bundles")
    if len(bundles) > 1:
        names = ", ".join(str(_mapping(b, f"{path}: tag_bundles").get("name", "?"))[:40] for b in bundles)
        raise VehicleError(f"{path}: has the bundles {names}, each in a separate frame: keep one of them")
    poses: dict[int, LaidTag] = {}
    for bundle in bundles:
        content = _mapping(bundle, f"{path}: tag_bundles")
        _refuse_unknown(content, {"name", "layout"}, f"{path}: bundle")
        for entry in _list(content.get("layout"), f"{path}: layout"):
            values = _mapping(entry, f"{path}: layout")
            tag = _id(values, f"{path}: layout")
            where = f"{path}: tag {tag}"
            _refuse_unknown(values, OF_BUNDLE, where)
            if tag in poses:
                raise VehicleError(f"{where} is there twice in the bundle: keep one of the two")
            position = _numbers([values.get(key, 0.0) for key in "xyz"], 3, f"{where}: x, y, z")
            turn = _unit(
                [values.get(f"q{key}", float(key == "w")) for key in "xyzw"], f"{where}: qx, qy, qz, qw"
            )
            poses[tag], sizes[tag] = LaidTag(position, turn), _size(values, where)
    if not sizes:
        raise VehicleError(f"{path}: has no tags: expected tag_bundles or standalone_tags of apriltag_ros")
    lost = [tag for tag in alone if poses and tag not in poses]
    remarks = (f"{path}: standalone tags {_named(lost)} have no pose and are not read",) if lost else ()
    return TagLayout(
        {tag: sizes[tag] for tag in poses or sizes}, poses, str(tree.get("tag_family") or ""), remarks
    )


def _ros_2(parameters: Mapping[Any, Any], path: Path) -> TagLayout:
    _refuse_unknown(parameters, OF_ROS_2, f"{path}: {PARAMETERS}")
    tag = _mapping(parameters.get("tag") or {}, f"{path}: tag")
    _refuse_unknown(tag, {"ids", "frames", "sizes"}, f"{path}: tag")
    ids = _list(tag.get("ids") or [], f"{path}: tag.ids")
    sizes = _list(tag.get("sizes") or [parameters.get("size")] * len(ids), f"{path}: tag.sizes")
    if not ids or len(sizes) != len(ids):
        raise VehicleError(
            f"{path}: tag has {len(ids)} ids and {len(sizes)} sizes, expected as many of each, and one or more"
        )
    found: dict[int, float] = {}
    for number, size in zip(ids, sizes, strict=True):
        entry = {"id": number, "size": size}
        found[_id(entry, f"{path}: tag.ids")] = _size(entry, f"{path}: tag.sizes")
    return TagLayout(found, family=str(parameters.get("family") or ""))


def _named(tags: Collection[int]) -> str:
    return ", ".join(map(str, sorted(tags)))


def _refuse_unknown(values: Mapping[Any, Any], known: Collection[str], where: str) -> None:
    for key in values:
        if key not in known:
            raise VehicleError(
                f"{where}: unknown key '{str(key)[:40]}'{did_you_mean(str(key), sorted(known))} expected one of "
                f"{', '.join(sorted(known))}"
            )


def _mapping(value: Any, where: str) -> Mapping[Any, Any]:
    if not isinstance(value, Mapping):
        raise VehicleError(f"{where} is {str(value)[:60]!r}, expected keys and values")
    return value


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise VehicleError(f"{where} is {str(value)[:60]!r}, expected a list")
    return value


def _id(values: Mapping[Any, Any], where: str) -> int:
    tag = values.get("id")
    if type(tag) not in (int, float) or not tag >= 0 or tag % 1 != 0:  # 00 is read as 0.0
        raise VehicleError(f"{where}: id is {str(tag)[:40]!r}, expected an integer from 0")
    return int(tag)


def _size(values: Mapping[Any, Any], where: str) -> float:
    (size,) = _numbers([values.get("size")], 1, f"{where}: size")
    if size <= 0.0:
        raise VehicleError(f"{where}: size is {size:g} m, expected above 0")
    return float(size)


def _numbers(values: Any, count: int, where: str) -> NDArray[np.float64]:
    plain = isinstance(values, (list, tuple)) and all(type(x) in (int, float) for x in values)
    if not plain or len(values) != count or not np.all(np.isfinite(values)):
        raise VehicleError(
            f"{where} is {str(values)[:60]}, expected {count} finite number{'s' * (count > 1)}"
        )
    return np.array(values, float)


def _unit(values: Any, where: str) -> NDArray[np.float64]:
    quaternion = _numbers(values, 4, where)
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > 1e-2:
        raise VehicleError(f"{where} has length {length:.4g}, expected 1")
    return np.asarray(quaternion / length)
