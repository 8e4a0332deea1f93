r"""BlocksExchange: the XML of ContextCapture (iTwin Capture), which Metashape and others export with their tie points.

Facts, of Bentley's format specification ("BlocksExchange XML/XMLZ format", version 2.1 and newer):

- XML: per photogroup (one camera) its parameters and photos, per tie point its position and measurements, by ids of
  photos.
- pose: rotation (M_ij, row i, column j) from world to camera and centre; the camera's axes are those of
  CameraOrientation, XRightYDown where that is missing. Omega / Phi / Kappa and Heading / Pitch / Roll are refused.
- pixels: the origin is the *centre* of the upper-left pixel, x right, y down, whatever the orientation; here half a
  pixel is added to measurements and principal points. A principal point that is missing is the image's centre.
- focal length: FocalLengthPixels, or FocalLength in mm with SensorSize (the larger side) or PixelSize. AspectRatio is
  read as fy / fx.
- lens: Brown's, x (1 + K1 r^2 + K2 r^4 + K3 r^6) + P1 (r^2 + 2 x^2) + 2 P2 x y, and y with P2 and P1: OpenCV's p1 is
  P2, its p2 P1.
- coordinates are of a spatial reference system; geographic ones (degrees) are refused, projected ones are taken for
  Cartesian.
- tie points without a position are 2D points without a 3D point. Metashape's *own* XML of cameras has no tie points
  at all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.assembly.raw import RawCamera, RawModel
from sfm_audit.loaders.errors import MalformedFileError, Position
from sfm_audit.loaders.foreign.lens import camera_of
from sfm_audit.loaders.foreign.one_file import only_file
from sfm_audit.loaders.foreign.rotations import quats_from_matrices, rotate
from sfm_audit.loaders.foreign.tables import Links, PlacedImage, Structure, raw_model
from sfm_audit.loaders.foreign.xml_file import Element, check_size, read_xml
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import is_number

PATTERN: Final = "*[Bb]locks[Ee]xchange*.xml"
_ROOT: Final = "BlocksExchange"
_TAKE: Final = frozenset({"SRS", "Photo", "Photogroup", "TiePoint", "ControlPoint", "Block", "SRSId"})
_ADVICE: Final = "check that this is a BlocksExchange file with tie points, or export it again"
_DIRECTIONS: Final = {"Right": (1, 0, 0), "Left": (-1, 0, 0), "Down": (0, 1, 0), "Up": (0, -1, 0)}
_MATRIX: Final = tuple(f"M_{row}{column}" for row in range(3) for column in range(3))
_DEGREES: Final = ("EPSG:4326", "WGS84", "WGS 84", "GEOGCS", "GEOGCRS", "+proj=longlat")


@dataclass(slots=True)
class _Block:
    """What was read so far; photos wait for the end of their photogroup, which names their axes."""

    path: InputPath
    cameras: list[RawCamera] = field(default_factory=list)
    waiting: list[tuple[int, str, list[float] | None, int]] = field(default_factory=list)
    images: list[tuple[int, str, int, FloatArray, list[float]]] = field(default_factory=list)
    photo_ids: set[int] = field(default_factory=set)
    points: list[list[float]] = field(default_factory=list)
    photo_of: list[int] = field(default_factory=list)
    point_of: list[int] = field(default_factory=list)
    xy: list[float] = field(default_factory=list)
    unlinked: dict[int, int] = field(default_factory=dict)
    systems: dict[str, str] = field(default_factory=dict)
    used_systems: set[str] = field(default_factory=set)
    num_blocks: int = 0

    def malformed(self, element: Element, wanted: str, got: str) -> MalformedFileError:
        """Return the error for an element."""
        return MalformedFileError(str(self.path), Position("line", element.line), wanted, got, _ADVICE)

    def take(self, element: Element) -> None:
        """Take an element that has ended."""
        if element.name == "SRS":
            self.systems[element.value("Id") or ""] = element.value("Definition") or ""
        elif element.name == "SRSId":
            self.used_systems.add(element.text.strip())
        elif element.name == "Photo":
            self._photo(element)
        elif element.name == "Photogroup":
            self._photogroup(element)
        elif element.name == "TiePoint":
            self._tie_point(element)
        elif element.name == "Block":
            self.num_blocks += 1
            if self.num_blocks > 1:
                raise self.malformed(element, "one block", "another one")

    def number(self, element: Element, *names: str) -> float:
        """Return the number in the element that the names lead to."""
        text = element.value(*names)
        if text is None or not is_number(text.encode()):
            shown = "none" if text is None else f"{text[:40]!r}"
            raise self.malformed(element, f"a number in <{'><'.join(names)}> of <{element.name}>", shown)
        return float(text)

    def optional(self, element: Element, *names: str, default: float = 0.0) -> float:
        """Return the number in an element that may be missing."""
        return default if element.value(*names) is None else self.number(element, *names)

    def whole(self, element: Element, *names: str) -> int:
        """Return the whole number in the element that the names lead to."""
        text = element.value(*names) or ""
        if not (text.isascii() and text.isdigit()) or len(text) > 10 or int(text) >= 2**32:
            wanted = f"a whole number below 2^32 in <{'><'.join(names)}> of <{element.name}>"
            raise self.malformed(element, wanted, f"{text[:40]!r}")
        return int(text)

    def _photo(self, element: Element) -> None:
        photo_id = self.whole(element, "Id")
        if photo_id in self.photo_ids:
            raise self.malformed(element, "a photo's Id that the file has not used before", f"{photo_id} again")
        self.photo_ids.add(photo_id)
        name = element.value("ImagePath") or f"photo {photo_id}"
        pose = element.find("Pose")
        rotation = pose.find("Rotation") if pose else None
        if pose is None or rotation is None or pose.find("Center") is None:
            self.waiting.append((photo_id, name, None, element.line))
            return
        if rotation.find("M_00") is None:
            got = ", ".join(child.name for child in rotation.children[:3]) or "nothing"
            raise self.malformed(rotation, "a rotation as a matrix (M_00 .. M_22)", got)
        numbers = [self.number(rotation, key) for key in _MATRIX]
        numbers += [self.number(pose, "Center", axis) for axis in ("x", "y", "z")]
        self.waiting.append((photo_id, name, numbers, element.line))

    def _photogroup(self, element: Element) -> None:
        camera_id = len(self.cameras)
        self.cameras.append(self._camera(camera_id, element))
        axes = self._axes(element)
        for photo_id, name, numbers, _ in self.waiting:
            if numbers is not None:
                matrix = axes.T @ np.array(numbers[:9]).reshape(3, 3)
                self.images.append((photo_id, name, camera_id, matrix, numbers[9:]))
        self.waiting.clear()

    def _axes(self, element: Element) -> FloatArray:
        """Return the matrix from axes x right, y down, z forwards to those of the photogroup."""
        words = element.value("CameraOrientation") or "XRightYDown"
        found = words[1:].split("Y", 1) if words.startswith("X") else []
        if len(found) != 2 or any(word not in _DIRECTIONS for word in found):
            raise self.malformed(element, "a CameraOrientation such as XRightYDown", f"{words[:40]!r}")
        x, y = (np.array(_DIRECTIONS[word], np.float64) for word in found)
        z = np.cross(x, y)
        if not z.any():
            raise self.malformed(element, "a CameraOrientation such as XRightYDown", f"{words[:40]!r}")
        return np.stack([x, y, z])

    def _camera(self, camera_id: int, element: Element) -> RawCamera:
        kind = element.value("CameraModelType") or "Perspective"
        if kind != "Perspective":
            raise self.malformed(element, "the CameraModelType Perspective", f"{kind[:40]!r}")
        width, height = (self.whole(element, "ImageDimensions", name) for name in ("Width", "Height"))
        if self.optional(element, "Skew") != 0.0:
            raise self.malformed(element, "no Skew", element.value("Skew") or "")
        focal = self._focal(element, max(width, height))
        values = {"fx": focal, "fy": focal * self.optional(element, "AspectRatio", default=1.0)}
        if element.find("PrincipalPoint") is None:
            values |= {"cx": width / 2, "cy": height / 2}
        else:
            values |= {name: self.number(element, "PrincipalPoint", name[1]) + 0.5 for name in ("cx", "cy")}
        names = {"k1": "K1", "k2": "K2", "k3": "K3", "p1": "P2", "p2": "P1"}
        values |= {ours: self.optional(element, "Distortion", theirs) for ours, theirs in names.items()}
        return camera_of(camera_id, (width, height), values)

    def _focal(self, element: Element, size: int) -> float:
        if element.value("FocalLengthPixels") is not None:
            return self.number(element, "FocalLengthPixels")
        focal = self.number(element, "FocalLength")
        is_pixel = element.value("PixelSize") is not None
        unit = self.number(element, "PixelSize") if is_pixel else self.number(element, "SensorSize") / max(size, 1)
        if unit == 0:
            raise self.malformed(element, "a SensorSize or PixelSize above 0", "0")
        return focal / unit

    def _tie_point(self, element: Element) -> None:
        is_placed = element.find("Position") is not None
        if is_placed:
            self.points.append([self.number(element, "Position", axis) for axis in ("x", "y", "z")])
        for measurement in element.children:
            if measurement.name != "Measurement":
                continue
            photo_id = self.whole(measurement, "PhotoId")
            if not is_placed:
                self.unlinked[photo_id] = self.unlinked.get(photo_id, 0) + 1
                continue
            self.photo_of.append(photo_id)
            self.point_of.append(len(self.points) - 1)
            self.xy += [self.number(measurement, "x") + 0.5, self.number(measurement, "y") + 0.5]

    def check_system(self) -> None:
        """Raise where coordinates are degrees, or of several systems."""
        if len(self.used_systems) > 1:
            got = ", ".join(sorted(self.used_systems)[:5])
            raise MalformedFileError(str(self.path), None, "one spatial reference system", f"SRSId {got}", _ADVICE)
        for system in self.used_systems:
            definition = self.systems.get(system, "")
            if definition.startswith(_DEGREES) and "PROJ" not in definition:
                advice = "export in a local or projected system"
                wanted = "coordinates in metres"
                raise MalformedFileError(str(self.path), None, wanted, f"degrees ({definition[:40]!r})", advice)


def _read(path: InputPath) -> _Block:
    block = _Block(path)
    read_xml(path, _ROOT, _TAKE, block.take, _ADVICE)
    block.check_system()
    return block


def read(folder: InputPath) -> RawModel:
    """Read the one BlocksExchange file in ``folder``; LoadError where that cannot be done."""
    path = only_file(folder, PATTERN)
    block = _read(path)
    names = [name for _, name, *_ in block.images]
    matrices = np.array([matrix for *_, matrix, _ in block.images]).reshape(-1, 3, 3)
    quats, findings = quats_from_matrices(path, matrices, names)
    translations = -rotate(quats, np.array([centre for *_, centre in block.images]).reshape(-1, 3))
    images = [
        PlacedImage(photo_id, name, camera_id, (*quat, *translation), block.unlinked.get(photo_id, 0))
        for (photo_id, name, camera_id, _, _), quat, translation in zip(
            block.images, quats.tolist(), translations.tolist(), strict=True
        )
    ]
    row_of = {image.image_id: row for row, image in enumerate(images)}
    return raw_model(
        path,
        block.cameras,
        images,
        Structure(np.arange(len(block.points), dtype=np.uint64), np.array(block.points).reshape(-1, 3)),
        Links(
            np.array([row_of.get(photo_id, -1) for photo_id in block.photo_of], np.int64),
            np.array(block.point_of, np.uint64),
            np.array(block.xy, np.float64).reshape(-1, 2),
        ),
        findings=findings,
    )


def count_images(folder: InputPath) -> int:
    """Return the number of photos, those without a pose included; all of the file is read."""
    return len(_read(only_file(folder, PATTERN)).photo_ids)


def check(folder: InputPath) -> None:
    """Raise LoadError where the file is too large to be read."""
    check_size(only_file(folder, PATTERN))


BLOCKS_EXCHANGE: Final = ModelFormat(
    name="blocks_exchange", required=(PATTERN,), read=read, count_images=count_images, check=check
)
