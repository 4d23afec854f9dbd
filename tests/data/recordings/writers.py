"""Writes a recording as each layout's own documentation says, from arrays: nothing of regnf is used."""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.data.recordings.truth import HEIGHT, WIDTH, Array, K, Truth

HALF = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
"""From pixel centers at whole numbers to centers at one half."""


def png(path: Path, image: NDArray[Any]) -> None:
    """8 bits a channel, or 16 bits of one channel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def png_bytes(image: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")
    return file.getvalue()


def depth_png(path: Path, depth: Array, steps_a_meter: float) -> None:
    """Whole steps; 0 for none."""
    png(path, np.round(depth * steps_a_meter).astype(np.uint16))


def text(path: Path, rows: NDArray[Any], form: str = "%.9f") -> None:
    """A matrix, a row a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows, form)


def camera_json(path: Path, **more: Any) -> None:
    """fx, fy, cx, cy and the size."""
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": WIDTH, "height": HEIGHT, **more}
    path.write_text(json.dumps(values))


def bop(folder: Path, truth: Truth) -> Path:
    cameras = {}
    for i, pose in enumerate(truth.poses):
        inverse = np.linalg.inv(pose)
        cameras[str(i)] = {
            "cam_K": K.ravel().tolist(),
            "depth_scale": 0.1,
            "cam_R_w2c": inverse[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000.0 * inverse[:3, 3]).tolist(),
        }
        depth_png(folder / f"depth/{i:06d}.png", truth.depths[i], 10000.0)
        png(folder / f"rgb/{i:06d}.png", truth.colors[i])
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def tum(folder: Path, truth: Truth) -> Path:
    names = {"depth": [], "rgb": []}  # type: dict[str, list[str]]
    for i, stamp in enumerate(truth.stamps):
        depth_png(folder / f"depth/{stamp:.4f}.png", truth.depths[i], 5000.0)
        png(folder / f"rgb/{stamp + 0.01:.4f}.png", truth.colors[i])
        names["depth"].append(f"{stamp:.4f} depth/{stamp:.4f}.png")
        names["rgb"].append(f"{stamp + 0.01:.4f} rgb/{stamp + 0.01:.4f}.png")
    for name, lines in names.items():
        (folder / f"{name}.txt").write_text("# color images\n" + "\n".join(lines) + "\n")
    # Poses at other times than the images, so that they must be interpolated: linear in between by construction.
    rows = [_tum_row(s, p) for s, p in zip(truth.stamps, truth.poses, strict=True)]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")
    camera_json(folder / "camera.json")
    return folder


def _tum_row(stamp: float, pose: Array) -> str:
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return " ".join(f"{value:.9f}" for value in (stamp, *pose[:3, 3], *quaternion))


def seven_scenes(folder: Path, truth: Truth) -> Path:
    for i, pose in enumerate(truth.poses):
        depth = np.round(truth.depths[i] * 1000.0).astype(np.uint16)
        depth[0, 0] = 65535
        png(folder / f"frame-{i:06d}.depth.png", depth)
        png(folder / f"frame-{i:06d}.color.png", truth.colors[i])
        text(folder / f"frame-{i:06d}.pose.txt", pose)
    text(folder / "camera-intrinsics.txt", K)
    return folder


def redwood(folder: Path, truth: Truth) -> Path:
    lines = []
    for i, pose in enumerate(truth.poses):
        depth_png(folder / f"depth/{i + 1:06d}.png", truth.depths[i], 1000.0)
        png(folder / f"image/{i + 1:06d}.png", truth.colors[i])
        lines += [f"{i} {i} {i + 1}", *(" ".join(f"{value:.9f}" for value in row) for row in pose)]
    (folder / "trajectory.log").write_text("\n".join(lines) + "\n")
    columns = K.T.ravel().tolist()
    (folder / "camera_intrinsic.json").write_text(
        json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": columns})
    )
    return folder


def pose_graph(folder: Path, truth: Truth) -> Path:
    redwood(folder, truth)
    (folder / "trajectory.log").unlink()
    nodes = [{"class_name": "PoseGraphNode", "pose": pose.T.ravel().tolist()} for pose in truth.poses]
    (folder / "pose_graph.json").write_text(json.dumps({"class_name": "PoseGraph", "nodes": nodes}))
    return folder


def scannet(folder: Path, truth: Truth) -> Path:
    wide = np.diag([2.0, 2.0, 1.0]) @ (K + HALF) - [
        [0, 0, 0.5],
        [0, 0, 0.5],
        [0, 0, 0],
    ]
    for i, pose in enumerate(truth.poses):
        depth_png(folder / f"depth/{i}.png", truth.depths[i], 1000.0)
        png(folder / f"color/{i}.png", truth.colors[i].repeat(2, axis=0).repeat(2, axis=1))
        text(folder / f"pose/{i}.txt", pose)
    lost = len(truth)
    depth_png(folder / f"depth/{lost}.png", truth.depths[0], 1000.0)
    text(folder / f"pose/{lost}.txt", np.full((4, 4), -np.inf))
    for name, matrix in (("intrinsic_depth", K), ("intrinsic_color", wide)):
        padded = np.eye(4)
        padded[:3, :3] = matrix
        text(folder / f"intrinsic/{name}.txt", padded)
    return folder


def replica(folder: Path, truth: Truth) -> Path:
    for i in range(len(truth)):
        depth_png(folder / f"results/depth{i:06d}.png", truth.depths[i], 6553.5)
        png(folder / f"results/frame{i:06d}.png", truth.colors[i])
    text(folder / "traj.txt", truth.poses.reshape(len(truth), 16))
    camera = {"w": WIDTH, "h": HEIGHT, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def nerfstudio(folder: Path, truth: Truth) -> Path:
    """Its axes are OpenGL's, its pixel centers lie at one half."""
    frames = []
    for i, pose in enumerate(truth.poses):
        depth_png(folder / f"depth/{i}.png", truth.depths[i], 1000.0)
        png(folder / f"images/{i}.png", truth.colors[i])
        opengl = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append(
            {"file_path": f"images/{i}.png", "depth_file_path": f"depth/{i}.png", "transform_matrix": opengl.tolist()}
        )
    camera = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **camera, "frames": frames}))
    return folder


def sdfstudio(folder: Path, truth: Truth) -> Path:
    frames = []
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = K + HALF
    for i, pose in enumerate(truth.poses):
        folder.mkdir(exist_ok=True)
        np.save(folder / f"{i:06d}_depth.npy", truth.depths[i].astype(np.float32))
        png(folder / f"{i:06d}_rgb.png", truth.colors[i])
        frames.append(
            {
                "rgb_path": f"{i:06d}_rgb.png",
                "sensor_depth_path": f"{i:06d}_depth.npy",
                "camtoworld": pose.tolist(),
                "intrinsics": intrinsics.tolist(),
            }
        )
    values = {"camera_model": "OPENCV", "height": HEIGHT, "width": WIDTH, "has_sensor_depth": True, "frames": frames}
    (folder / "meta_data.json").write_text(json.dumps(values))
    return folder


def colmap_text(folder: Path, truth: Truth) -> Path:
    """Pixel centers lie at one half."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    numbers = f"{K[0, 0]} {K[1, 1]} {K[0, 2] + 0.5} {K[1, 2] + 0.5}"
    (model / "cameras.txt").write_text(f"# list\n1 PINHOLE {WIDTH} {HEIGHT} {numbers}\n")
    lines = ["# list"]
    for i, pose in enumerate(truth.poses):
        inverse = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        place = " ".join(f"{value:.9f}" for value in (w, x, y, z, *inverse[:3, 3]))
        lines += [f"{i + 1} {place} 1 view {i}.png", "1.0 2.0 -1" if i % 2 else ""]
        depth_png(folder / f"depth/view {i}.png", truth.depths[i], 1000.0)
        png(folder / f"images/view {i}.png", truth.colors[i])
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def colmap_binary(folder: Path, truth: Truth) -> Path:
    colmap_text(folder, truth)
    model = folder / "sparse" / "0"
    for path in model.iterdir():
        path.unlink()
    parameters = (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
    (model / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, *parameters))
    data = struct.pack("<Q", len(truth))
    for i, pose in enumerate(truth.poses):
        inverse = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        data += struct.pack("<i7di", i + 1, w, x, y, z, *inverse[:3, 3], 1) + f"view {i}.png".encode() + b"\0"
        data += struct.pack("<Qddq", 1, 1.0, 2.0, -1)
    (model / "images.bin").write_bytes(data)
    return folder


Writer = Callable[[Path, Truth], Path]
# Apps of phones: ARKit's cameras look against z. Facts by the apps' documentation and files that people show.

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def polycam(folder: Path, truth: Truth) -> Path:
    for i, pose in enumerate(truth.poses @ _OPENGL):
        name = str(1442008525605 + 100_000 * i)
        depth_png(folder / f"keyframes/depth/{name}.png", truth.depths[i], 1000.0)
        png(folder / f"keyframes/images/{name}.png", truth.colors[i])
        (folder / "keyframes/cameras").mkdir(exist_ok=True)
        entries = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        camera_json(folder / f"keyframes/cameras/{name}.json", **entries, blur_score=90.0)
    return folder


def scanner_app(folder: Path, truth: Truth) -> Path:
    for i, pose in enumerate(truth.poses @ _OPENGL):
        depth_png(folder / f"depth_{i:05d}.png", truth.depths[i], 1000.0)
        png(folder / f"frame_{i:05d}.png", truth.colors[i])
        said = {"cameraPoseARFrame": pose.ravel().tolist(), "intrinsics": K.ravel().tolist(), "frame_index": i}
        (folder / f"frame_{i:05d}.json").write_text(json.dumps(said))
    return folder


def record3d(folder: Path, truth: Truth) -> Path:
    poses = truth.poses @ _OPENGL
    for i, depth in enumerate(truth.depths):
        exr(folder / f"depth/{i}.exr", depth)
        png(folder / f"rgb/{i}.png", truth.colors[i])
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.concatenate([turns, poses[:, :3, 3]], axis=1).tolist()
    said = {"w": WIDTH, "h": HEIGHT, "K": K.T.ravel().tolist(), "fps": 60, "poses": rows}
    (folder / "metadata.json").write_text(json.dumps(said))
    return folder


def exr(path: Path, depth: Array, compression: int = 3) -> None:
    """One channel R of 32 bits: 0: as it is, 2: each line, 3: blocks of 16 lines by zip."""
    height, width = depth.shape

    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    window, zeros = struct.pack("<4i", 0, 0, width - 1, height - 1), struct.pack("<2f", 0.0, 0.0)
    channel = b"R\0" + struct.pack("<iBBBBii", 2, 0, 0, 0, 0, 1, 1) + b"\0"
    head = b"\x76\x2f\x31\x01\x02\0\0\0" + attribute(b"channels", b"chlist", channel)
    head += attribute(b"compression", b"compression", bytes([compression]))
    head += attribute(b"dataWindow", b"box2i", window) + attribute(b"displayWindow", b"box2i", window)
    head += attribute(b"lineOrder", b"lineOrder", b"\0") + attribute(b"screenWindowCenter", b"v2f", zeros) + b"\0"
    blocks, step = [], {0: 1, 2: 1, 3: 16}.get(compression, 32)
    for top in range(0, height, step):
        raw = depth[top : top + step].astype("<f4").tobytes()
        halves = np.frombuffer(raw[::2] + raw[1::2], np.uint8).astype(np.int64)
        packed = zlib.compress(np.append(halves[:1], (np.diff(halves) + 128) % 256).astype(np.uint8).tobytes())
        data = packed if compression and len(packed) < len(raw) else raw
        blocks.append(struct.pack("<ii", top, len(data)) + data)
    ends = np.cumsum([len(head) + 8 * len(blocks), *map(len, blocks[:-1])]).tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(head + struct.pack(f"<{len(ends)}Q", *ends) + b"".join(blocks))


FOLDERS: dict[str, tuple[Writer, float]] = {
    "bop": (bop, 1e-4),
    "tum": (tum, 2e-4),
    "7scenes": (seven_scenes, 1e-3),
    "redwood": (redwood, 1e-3),
    "pose graph": (pose_graph, 1e-3),
    "scannet": (scannet, 1e-3),
    "replica": (replica, 2e-4),
    "nerfstudio": (nerfstudio, 1e-3),
    "sdfstudio": (sdfstudio, 1e-6),
    "colmap": (colmap_text, 1e-3),
    "colmap binary": (colmap_binary, 1e-3),
    "polycam": (polycam, 1e-3),
    "3d scanner app": (scanner_app, 1e-3),
    "record3d": (record3d, 1e-6),
}
"""Writers, and the step of the depths they write, m."""


# ROS bags: by rosbags' own writer.

OPTICAL = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.05], [0.0, 0.0, 0.0, 1.0]])
"""From the camera's optical frame to the robot's body."""


def bag(path: Path, truth: Truth, storage: str = "mcap", coding: str = "16UC1", poses: str = "tf") -> Path:
    """depth, color, CameraInfo; the camera's place by tf through the body, or by odometry of the body."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3

    def make(name: str, *values: Any) -> Any:
        return types[name](*values)

    def header(stamp: float, frame: str) -> Any:
        seconds = int(stamp)
        time = make("builtin_interfaces/msg/Time", seconds, round((stamp - seconds) * 1e9))
        return make("std_msgs/msg/Header", time, frame)

    def placed(matrix: Array, place: str, pose: str) -> Any:
        quaternion = make("geometry_msgs/msg/Quaternion", *Rotation.from_matrix(matrix[:3, :3]).as_quat())
        return make(f"geometry_msgs/msg/{pose}", make(f"geometry_msgs/msg/{place}", *matrix[:3, 3]), quaternion)

    def transform(stamp: float, parent: str, child: str, matrix: Array) -> Any:
        value = placed(matrix, "Vector3", "Transform")
        return make("geometry_msgs/msg/TransformStamped", header(stamp, parent), child, value)

    with Writer(path, version=9, storage_plugin=plugin) as writer:

        def topic(name: str, kind: str) -> Callable[[float, Any], None]:
            connection = writer.add_connection(name, kind, typestore=store)
            return lambda stamp, value: writer.write(connection, int(stamp * 1e9), store.serialize_cdr(value, kind))

        image = "sensor_msgs/msg/CompressedImage" if "compressed" in coding else "sensor_msgs/msg/Image"
        depths, colors = (
            topic("/camera/depth/image_rect_raw", image),
            topic("/camera/color/image", "sensor_msgs/msg/Image"),
        )
        info = topic("/camera/depth/camera_info", "sensor_msgs/msg/CameraInfo")
        tf, fixed = topic("/tf", "tf2_msgs/msg/TFMessage"), topic("/tf_static", "tf2_msgs/msg/TFMessage")
        odometry = topic("/odom", "nav_msgs/msg/Odometry")
        region = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        start = truth.stamps[0]
        fixed(start, make("tf2_msgs/msg/TFMessage", [transform(start, "body", "optical", OPTICAL)]))
        for stamp, depth, color, pose in zip(truth.stamps, truth.depths, truth.colors, truth.poses, strict=True):
            body = pose @ np.linalg.inv(OPTICAL)
            if poses == "tf":
                tf(stamp, make("tf2_msgs/msg/TFMessage", [transform(stamp, "map", "body", body)]))
            else:
                with_covariance = make(
                    "geometry_msgs/msg/PoseWithCovariance", placed(body, "Point", "Pose"), np.zeros(36)
                )
                still = make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
                twist = make(
                    "geometry_msgs/msg/TwistWithCovariance", make("geometry_msgs/msg/Twist", still, still), np.zeros(36)
                )
                odometry(stamp, make("nav_msgs/msg/Odometry", header(stamp, "odom"), "body", with_covariance, twist))
            matrix = [K.ravel(), np.eye(3).ravel(), np.eye(3, 4).ravel()]
            info(
                stamp,
                make(
                    "sensor_msgs/msg/CameraInfo",
                    header(stamp, "optical"),
                    HEIGHT,
                    WIDTH,
                    "plumb_bob",
                    np.zeros(5),
                    *matrix,
                    0,
                    0,
                    region,
                ),
            )
            depths(stamp, make(image, header(stamp, "optical"), *_coded(depth, coding)))
            row = color.reshape(-1)
            colors(
                stamp + 0.005,
                make(
                    "sensor_msgs/msg/Image", header(stamp + 0.005, "optical"), HEIGHT, WIDTH, "rgb8", 0, 3 * WIDTH, row
                ),
            )
    return path


def _coded(depth: Array, coding: str) -> tuple[Any, ...]:
    millimeters = np.round(1000.0 * depth).astype(np.uint16)
    if coding == "16UC1":
        return HEIGHT, WIDTH, coding, 0, 2 * WIDTH, np.frombuffer(millimeters.tobytes(), np.uint8)
    if coding == "32FC1":
        return HEIGHT, WIDTH, coding, 0, 4 * WIDTH, np.frombuffer(depth.astype(np.float32).tobytes(), np.uint8)
    data = struct.pack("<iff", 0, 0.0, 0.0) + png_bytes(millimeters)
    return "16UC1; compressedDepth png", np.frombuffer(data, np.uint8)
