"""Writes OpenMVG's sfm_data.bin from what its JSON says; nothing of the loaders is used here.

Source: OpenMVG's ``sfm_data_io_cereal.cpp`` and ``*_io.hpp``, cereal's ``portable_binary.hpp`` and ``types``.
"""

import struct

import foreign_scene as fs


class Writer:
    def __init__(self, order: str = "<") -> None:
        self.order = order
        self.parts = [bytes([order == "<"])]

    def put(self, codes: str, *values: object) -> None:
        self.parts.append(struct.pack(self.order + codes, *values))

    def text(self, value: str) -> None:
        self.put("Q", len(value.encode()))
        self.parts.append(value.encode())

    def vector(self, values: list[float]) -> None:
        self.put(f"Q{len(values)}d", len(values), *values)

    def entries(self, rows: list[dict], write_one) -> None:
        self.put("Q", len(rows))
        for row in rows:
            self.put("I", row["key"])
            write_one(row["value"])


class SfmData(Writer):
    """Writes the parts of a file; ``data``: as `foreign_scene.openmvg_data` makes it, not wrapped."""

    def pointer(self, value: dict) -> dict | None:
        self.put("I", value["ptr_wrapper"]["id"])
        return value["ptr_wrapper"].get("data")

    def kind(self, value: dict) -> None:
        self.put("I", value["polymorphic_id"])
        if "polymorphic_name" in value:
            self.text(value["polymorphic_name"])

    def view(self, value: dict) -> None:
        self.kind(value)
        self.old_view(value)

    def old_view(self, value: dict) -> None:
        found = self.pointer(value)
        if found is not None:
            self.text(found["local_path"])
            self.text(found["filename"])
            self.put("5I", *(found[name] for name in ("width", "height", "id_view", "id_intrinsic", "id_pose")))
            if "center" in found:
                self.put("B", 1)
                self.vector(found["center_weight"])
                self.vector(found["center"])

    def intrinsic(self, value: dict) -> None:
        self.kind(value)
        found = self.pointer(value)
        if found is not None:
            self.put("IId", found["width"], found["height"], found["focal_length"])
            self.vector(found["principal_point"])
            for key in {"disto_k1", "disto_k3", "disto_t2", "fisheye"} & set(found):
                self.vector(found[key])

    def pose(self, value: dict) -> None:
        self.put("Q", 3)
        for row in value["rotation"]:
            self.vector(row)
        self.vector(value["center"])

    def observation(self, value: dict) -> None:
        self.put("I", value["id_feat"])
        self.vector(value["x"])

    def landmark(self, value: dict) -> None:
        self.vector(value["X"])
        self.entries(value["observations"], self.observation)


def openmvg_binary(data: dict, order: str = "<") -> bytes:
    out = SfmData(order)
    version = data["sfm_data_version"]
    out.text(version)
    out.text(data["root_path"])
    out.entries(data["views"], out.view if version == "0.3" else out.old_view)
    out.entries(data["intrinsics"], out.intrinsic)
    out.entries(data["extrinsics"], out.pose)
    out.entries(data["structure"], out.landmark)
    if version != "0.1":
        out.entries(data["control_points"], out.landmark)
    return b"".join(out.parts)


def openmvg_binary_files(made: fs.Scene, kind: str = "pinhole_radial_k3", order: str = "<") -> dict[str, bytes]:
    return {"sfm_data.bin": openmvg_binary(fs.openmvg_data(made, kind), order)}
