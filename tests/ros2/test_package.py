"""The ROS 2 package: its logic, its node against stubs of the published messages, its launch file."""

from __future__ import annotations

import importlib
import json
import re
import runpy
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import torch
import yaml
from jsonschema import Draft202012Validator  # type: ignore[import-untyped]

from regnf_core import Sim3
from tests.ros2.conftest import PACKAGE, Buffer, Node
from tests.ros2.messages import TYPES

ROOT = PACKAGE.parents[1]
SCENE, CHAIR = "ab" * 32, "cd" * 32
T_OBJECT_FIELD = Sim3.from_quaternion(1.25, [0.1, -0.2, 0.3, 0.9], [0.4, -0.7, 0.2])
pytestmark = pytest.mark.usefixtures("ros")


def part(name: str) -> Any:
    return importlib.import_module(f"regnf_ros.{name}")


def result(verdict: str = "registered", alternatives: tuple[Sim3, ...] = ()) -> dict[str, Any]:
    return {
        "verdict": verdict,
        "T_object_scene": T_OBJECT_FIELD.to_dict(),
        "alternatives": [{"T_object_scene": one.to_dict()} for one in alternatives],
        "covariance": (1e-4 * np.eye(7)).tolist(),
        "probability": 0.97,
        "level": "default",
    }


class Answers:
    """A service that answers as the contract says: a job that is running first, then its result."""

    def __init__(self, document: dict[str, Any]) -> None:
        self.document = document
        self.requests: list[dict[str, Any]] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        assert request.headers["authorization"] == "Bearer open-sesame"
        if request.method == "POST":
            self.requests.append(json.loads(request.content))
            return httpx.Response(202, json={"id": "j1", "status": "running"})
        if request.url.path == "/jobs/j1/result":
            return httpx.Response(200, json=self.document)
        return httpx.Response(200, json={"id": "j1", "status": "successful"})


def make_node(monkeypatch: pytest.MonkeyPatch, answers: Any, **given: Any) -> Any:
    """answers: a function of requests, or a transport."""
    monkeypatch.setenv("REGNF_API_TOKEN", "open-sesame")
    usual = {"server": "http://127.0.0.1:1", "scene": SCENE, "objects": f"chair={CHAIR}"}
    monkeypatch.setattr(Node, "given", usual | given)
    service = part("service").Service
    transport = answers if isinstance(answers, httpx.BaseTransport) else httpx.MockTransport(answers)
    monkeypatch.setattr(part("node"), "Service", lambda address, token: service(address, token, transport))
    monkeypatch.setattr(part("node").RegisterObjects, "work", lambda self, *what: None)
    return part("node").RegisterObjects()


def answered(monkeypatch: pytest.MonkeyPatch, document: Any = None, **given: Any) -> tuple[Any, dict[str, Any]]:
    """A node that has answered the usual detections, and what it asked the service for."""
    answers = Answers(document or result())
    node = make_node(monkeypatch, answers, **given)
    node.answer(detections())
    return node, answers.requests[0]


@cache
def contract() -> Any:
    return yaml.safe_load((ROOT / "openapi.yaml").read_text(encoding="utf-8"))["components"]


def contract_takes(schema: str, request: dict[str, Any]) -> None:
    reference = {"$ref": f"#/components/schemas/{schema}", "components": contract()}
    Draft202012Validator(reference).validate(request)


def detections(class_id: str = "chair", frame: str = "map") -> Any:
    array, one = TYPES["vision_msgs/Detection3DArray"](), TYPES["vision_msgs/Detection3D"]()
    array.header.frame_id, array.header.stamp.sec = frame, 12
    hypothesis = TYPES["vision_msgs/ObjectHypothesisWithPose"]()
    hypothesis.hypothesis.class_id, hypothesis.hypothesis.score = class_id, 0.8
    less = TYPES["vision_msgs/ObjectHypothesisWithPose"]()
    less.hypothesis.class_id, less.hypothesis.score = "table", 0.1
    one.results = [less, hypothesis]
    one.bbox.center.position.x = 1.0
    one.bbox.size.x, one.bbox.size.y, one.bbox.size.z = 0.5, 0.6, 0.7
    array.detections = [one]
    return array


def matrix(pose: Any, scale: float) -> np.ndarray[Any, Any]:
    """T_map_object of a published pose and scale, by the project's own Sim3."""
    turn, place = pose.orientation, pose.position
    quaternion = [turn.x, turn.y, turn.z, turn.w]
    return Sim3.from_quaternion(scale, quaternion, [place.x, place.y, place.z]).matrix().numpy()


def test_a_pose_is_published_in_the_map_with_its_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    node, _ = answered(monkeypatch)
    (array,), (pose,), (frame,) = node.found_out.sent, node.pose_out.sent, node.broadcaster.sent
    wanted = T_OBJECT_FIELD.inverse().matrix().numpy()
    scale = float(array.detections[0].id.rpartition("=")[2])
    np.testing.assert_allclose(scale, 0.8)
    np.testing.assert_allclose(matrix(pose.pose.pose, scale), wanted, atol=1e-6)
    np.testing.assert_allclose(matrix(array.detections[0].results[0].pose.pose, scale), wanted, atol=1e-6)
    assert (frame.header.frame_id, frame.child_frame_id, frame.header.stamp.sec) == ("map", "regnf/chair_0", 12)
    assert frame.transform.translation.x == pose.pose.pose.position.x
    assert array.detections[0].results[0].hypothesis.score == 0.97
    assert array.detections[0].id.startswith("chair/0/level=default/")
    assert array.detections[0].bbox.size.z == 0.7
    assert np.any(pose.pose.covariance)


def test_the_request_is_one_that_the_contract_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    _, request = answered(monkeypatch, up_axis="z")
    contract_takes("RegisterRequest", request)
    assert (request["scene"], request["object"], request["options"]) == (SCENE, CHAIR, {"up_axis": "z"})
    assert (request["detection"]["center"], request["detection"]["size"]) == ([1.0, 0.0, 0.0], [0.5, 0.6, 0.7])


def test_objects_in_meters_bound_the_scale(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 0.25}))
    _, quarter = answered(monkeypatch, dataparser_transforms=str(file), scale_tolerance="0.03")
    _, metric = answered(monkeypatch, scale_tolerance="0")
    bounds = pytest.approx({"min_scale": 3.88, "max_scale": 4.12})  # an object's meters for each of the field's units
    assert quarter["options"]["robust"] == bounds
    assert metric["options"]["robust"] == {"min_scale": 1.0, "max_scale": 1.0}
    _, inches = answered(monkeypatch, scale_tolerance="0.1", object_unit="in")
    bounds = {name: pytest.approx(share / 0.0254) for name, share in (("min_scale", 0.9), ("max_scale", 1.1))}
    assert inches["options"]["robust"] == {"object_unit": "in", **bounds}
    _, known = answered(monkeypatch, object_unit="mm")
    assert known["options"]["robust"] == {"object_unit": "mm"}
    _, scaled = answered(monkeypatch, dataparser_transforms=str(file), object_unit="mm")
    assert {name: scaled["options"]["robust"][name] for name in ("min_scale", "max_scale")} == pytest.approx(
        {"min_scale": 3960.0, "max_scale": 4040.0}
    )
    _, free = answered(monkeypatch, object_unit="free", scale_tolerance="0.1")
    assert free["options"]["robust"] == {"object_unit": "free"}
    with pytest.raises(ValueError, match="object_unit: 'ft' is not one of auto, free, m, cm, mm, in"):
        make_node(monkeypatch, Answers(result()), object_unit="ft")
    for wrong in ("-0.1", "1", "nan", "little"):
        with pytest.raises(ValueError, match=r"scale_tolerance|could not convert"):
            make_node(monkeypatch, Answers(result()), scale_tolerance=wrong)


def test_a_field_in_its_trainers_frame_gives_poses_in_meters(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    parser = {"transform": [[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, -0.2]], "scale": 0.25}
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps(parser))
    node, request = answered(monkeypatch, dataparser_transforms=str(file))
    # nerfstudio: a point of the dataset is trained at scale * (transform @ point)
    np.testing.assert_allclose(request["detection"]["center"], [0.25 * 0.3, 0.25 * 1.1, 0.25 * -0.2])
    np.testing.assert_allclose(request["detection"]["size"], [0.125, 0.15, 0.175])
    T_field_map = np.eye(4)
    T_field_map[:3] = 0.25 * np.array(parser["transform"])
    wanted = np.linalg.inv(T_OBJECT_FIELD.matrix().numpy() @ T_field_map)
    (array,) = node.found_out.sent
    scale = float(array.detections[0].id.rpartition("=")[2])
    np.testing.assert_allclose(matrix(node.pose_out.sent[0].pose.pose, scale), wanted, atol=1e-5)


def test_a_box_of_another_frame_is_carried_to_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = Answers(result())
    node = make_node(monkeypatch, answers)
    node.answer(detections(frame="camera"))
    assert answers.requests == []
    assert "no transform from camera to map" in node.log.lines[-1]
    stamped = TYPES["geometry_msgs/TransformStamped"]()
    stamped.transform.translation.z = 1.5
    monkeypatch.setattr(Buffer, "known", stamped)
    node.answer(detections(frame="camera"))
    np.testing.assert_allclose(answers.requests[0]["detection"]["center"], [1.0, 0.0, 1.5])


def test_all_poses_of_an_ambiguous_result_are_hypotheses(monkeypatch: pytest.MonkeyPatch) -> None:
    node, _ = answered(monkeypatch, result("ambiguous", (Sim3.identity(),)))
    assert len(node.found_out.sent[0].detections[0].results) == 2


@pytest.mark.parametrize(
    ("answers", "class_id", "told"),
    [
        (Answers(result("rejected")), "chair", "rejected"),
        (Answers(result()), "lamp", "no object for the class 'lamp'"),
        (lambda request: httpx.Response(503, json={"reason": "QUEUE_FULL", "detail": "later"}), "chair", "QUEUE_FULL"),
        (lambda request: httpx.Response(502, text="<html>"), "chair", "ANSWER_UNREADABLE"),
    ],
)
def test_what_is_not_found_is_not_published_and_is_said(
    monkeypatch: pytest.MonkeyPatch, answers: Any, class_id: str, told: str
) -> None:
    node = make_node(monkeypatch, answers)
    node.answer(detections(class_id))
    assert node.found_out.sent[0].detections == []
    assert node.pose_out.sent == node.broadcaster.sent == []
    assert told in node.log.lines[-1]


def test_more_detections_than_the_service_can_take_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    node = make_node(monkeypatch, Answers(result()))
    for _ in range(part("node").WAITING + 1):
        node.take(detections())
    assert "dropped" in node.log.lines[-1]


def test_the_covariance_is_that_of_small_motions() -> None:
    """Against the poses themselves: each of the seven directions, by central differences."""
    poses = part("poses")
    T_field_map = np.eye(4)
    T_field_map[:3] = 0.25 * np.array([[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, -0.2]])
    half = np.random.default_rng(0).normal(size=(7, 7))
    covariance = half @ half.T

    def pose(step: np.ndarray[Any, Any]) -> Any:
        moved = T_OBJECT_FIELD.perturb(torch.from_numpy(step))
        return poses.object_pose(moved.matrix().numpy(), None, T_field_map)

    size, columns = 1e-5, []
    for direction in np.eye(7):
        ahead, behind = pose(size * direction), pose(-size * direction)
        turn = poses.rotation_matrix(ahead.quaternion) @ poses.rotation_matrix(behind.quaternion).T
        skew = (turn - turn.T) / 2
        about = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        columns.append(np.concatenate([np.subtract(ahead.position, behind.position), about]) / (2 * size))
    J = np.stack(columns, axis=1)
    found = poses.pose_covariance(T_OBJECT_FIELD.matrix().numpy(), covariance, T_field_map)
    np.testing.assert_allclose(found, J @ covariance @ J.T, rtol=1e-5, atol=1e-6)


def test_quaternions_go_there_and_back() -> None:
    poses = part("poses")
    for given in np.random.default_rng(1).normal(size=(50, 4)):
        R = poses.rotation_matrix(tuple(given))
        np.testing.assert_allclose(poses.rotation_matrix(poses.quaternion_xyzw(R)), R, atol=1e-12)
    with pytest.raises(ValueError, match="quaternion"):
        poses.rotation_matrix((0.0, 0.0, 0.0, 0.0))


def test_a_bad_dataparser_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "dataparser_transforms.json"
    for text in ("[]", "{}", '{"transform": [[1]], "scale": 1}', '{"transform": [], "scale": "x"}', "x"):
        file.write_text(text)
        with pytest.raises(ValueError, match="dataparser_transforms"):
            part("poses").field_from_map(str(file))


BOOLEANS = {
    **dict.fromkeys(("y", "Y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"), True),
    **dict.fromkeys(("n", "N", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"), False),
}


def of_rcl(text: str) -> Any:
    """A parameter's value as rcl takes it from YAML: github.com/ros2/rcl, rcl_yaml_param_parser, `get_value`.

    Quoted scalars are texts. Of others, words for booleans come first, then whole numbers to any base, then what
    strtod takes; null and ~ are texts.
    """
    (event,) = (one for one in yaml.parse(text) if isinstance(one, yaml.ScalarEvent))
    if event.style in ("'", '"'):
        return event.value
    if event.value in BOOLEANS:
        return BOOLEANS[event.value]
    for kind in (lambda word: int(word, 0), float):
        if "_" not in event.value:
            try:
                return kind(event.value)
            except ValueError:
                pass
    return event.value


def launched(text: str) -> Any:
    """A text of a launch file: launch_ros writes it with PyYAML, which quotes by YAML 1.1 of its own, rcl reads it."""
    return of_rcl(yaml.dump({"p": text}).partition(":")[2])


PASSED = [launched, of_rcl]


@pytest.mark.parametrize("passed", PASSED)
def test_axes_and_shares_arrive_whatever_yaml_makes_of_them(passed: Callable[[str], Any]) -> None:
    axis_of, share_of = part("parameters").axis_of, part("parameters").share_of
    for said in ("x", "y", "z", "X", "Y", "Z", "+y", "axis_y", "y-axis"):
        assert axis_of("up_axis", passed(said)) == re.sub("axis|[-+_]", "", said).lower()
    for said in ("n", "no", "off", "null", "~", "1", "-y", "up", "nan"):
        with pytest.raises(ValueError, match=r"up_axis: .* is not x, y or z"):
            axis_of("up_axis", passed(said))
    for said, share in {"0.03": 0.03, "1e-3": 0.001, "0": 0.0, "3e-2": 0.03, ".5": 0.5}.items():
        assert share_of("scale_tolerance", passed(said)) == share
    said = ("1", "-0.1", "3%", "true", "y", "no", "nan", ".nan", ".inf", "inf", "0,03")
    for value in ([0.1], *map(passed, said)):
        with pytest.raises(ValueError, match=r"scale_tolerance: .* is not a number"):
            share_of("scale_tolerance", value)


def test_a_text_that_yaml_has_changed_is_refused_and_quotes_keep_it() -> None:
    for said in ("on", "no", "y", "12", "0x1f", "1e5", "0.5", "nan"):
        with pytest.raises(ValueError, match=f"map_frame: .*{of_rcl(said)!r}.*quotes"):
            part("parameters").text_of("map_frame", of_rcl(said))
        assert part("parameters").text_of("map_frame", of_rcl(f"'{said}'")) == said


NAMES = ["chair", "dining table", "a=b", "a, b", "rack: left", "Stühle", "y", "12", "{x}", "a;b", 'the "big" one']


@pytest.mark.parametrize("name", NAMES)
def test_classes_have_any_name(name: str) -> None:
    objects, table = part("parameters").objects_of, {name: CHAIR, "other one": SCENE}
    entries = [f"{one}={digest}" for one, digest in table.items()]
    for separator in (" ", ", ", ";", "\n"):
        assert objects(launched(separator.join(reversed(entries)))) == table
    assert objects(entries) == table
    for said in (json.dumps(entries), json.dumps(table), json.dumps(table, ensure_ascii=False)):
        assert objects(launched(said)) == table


@pytest.mark.parametrize(
    "value",
    ["chair", "chair=", "=" + CHAIR, "chair=ab", f"a={CHAIR} a={SCENE}", f"a={CHAIR} b", ["chair"], [5], True, 3, "[1]",
     '["a', f'{{"a": "{CHAIR}", "a": "{SCENE}"}}'],
)  # fmt: skip
def test_a_bad_table_of_objects_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="objects"):
        part("parameters").objects_of(value)


def test_parameters_of_any_type_reach_the_registration(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = Answers(result())
    given = {"up_axis": launched("y"), "scale_tolerance": of_rcl("0.03"), "objects": [f"dining table={CHAIR}"]}
    node = make_node(monkeypatch, answers, **given)
    node.answer(detections("dining table"))
    options = answers.requests[0]["options"]
    assert (options["up_axis"], answers.requests[0]["object"]) == ("y", CHAIR)
    assert options["robust"] == pytest.approx({"min_scale": 0.97, "max_scale": 1.03})


def test_a_wrong_parameter_ends_the_node_with_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="map_frame"):
        make_node(monkeypatch, Answers(result()), map_frame=True)
    log = Node("regnf").log
    monkeypatch.setattr(part("node"), "get_logger", lambda name: log)
    for name in ("init", "try_shutdown"):
        monkeypatch.setattr(sys.modules["rclpy"], name, lambda: None)
    log.fatal = log.info  # type: ignore[attr-defined]
    assert part("node").main() == 2
    assert log.lines == ["map_frame: expected a text, but YAML reads True; put it into quotes: map_frame:=\"'...'\""]


def test_the_token_is_in_a_file_or_a_variable_and_no_parameter(tmp_path: Path) -> None:
    token = part("parameters").token_of
    assert "token" not in part("node").PARAMETERS
    file = tmp_path / "token"
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        file.write_bytes("open-sesame\r\n".encode(encoding))
        assert token(str(file), {"REGNF_API_TOKEN": "other"}) == "open-sesame"
    assert token("", {"REGNF_API_TOKEN": "open-sesame\r"}) == "open-sesame"
    assert token("", {}) == ""
    with pytest.raises(ValueError, match=r"token_file: .*nothing cannot be read"):
        token(str(tmp_path / "nothing"), {})


def test_the_launch_file_gives_each_parameter_of_the_node() -> None:
    made = runpy.run_path(str(PACKAGE / "launch" / "regnf.launch.py"))["generate_launch_description"]()
    *declared, node = made
    names = {one.arguments[0] for one in declared}
    topics = {topic: name.arguments[0] for topic, name in node.named["remappings"]}
    assert set(node.named["parameters"][0]) == set(part("node").PARAMETERS)
    assert names == set(part("node").PARAMETERS) | set(topics.values())
    assert (node.named["package"], node.named["executable"]) == ("regnf_ros", "register_objects")


def test_the_logic_needs_no_ros() -> None:
    code = "import regnf_ros.objects, sys; print(sorted({'rclpy', 'torch', 'tf2_ros'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=PACKAGE, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_package_is_declared_as_it_is() -> None:
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert package.findtext("name") == "regnf_ros"
    needed = {one.text for one in package.findall("exec_depend")}
    assert {"rclpy", "vision_msgs", "geometry_msgs", "tf2_ros", "launch_ros"} <= needed
    assert package.findtext("export/build_type") == "ament_python"
    setup = (PACKAGE / "setup.py").read_text(encoding="utf-8")
    compile(setup, "setup.py", "exec")
    for file in ("resource/regnf_ros", "package.xml", "launch/regnf.launch.py"):
        assert (PACKAGE / file).is_file()
