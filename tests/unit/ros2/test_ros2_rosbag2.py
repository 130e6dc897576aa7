"""A log as a bag, read by rosbags' own reader."""

from __future__ import annotations

import json

import numpy as np
import pytest
from made_logs import written

from pbonet.log import Log
from pbonet.ros2 import rosbag2
from pbonet.ros2.topics_file import Publish, Topics

reader = pytest.importorskip("rosbags.highlevel")


def test_a_bag_has_the_values_and_times_of_the_log(tmp_path, call) -> None:
    log = Log(written(tmp_path / "r.mcap", count=300))
    status, out, _ = call(
        "log", "export", tmp_path / "r.mcap", "--rosbag2", tmp_path / "bag", "--json"
    )
    assert (status, json.loads(out)["topics"]) == (0, {"/arm/variables/y": 300})
    with reader.AnyReader([tmp_path / "bag"]) as bag:
        assert [one.topic for one in bag.connections] == ["/arm/variables/y"]
        got = [
            (time_ns, bag.deserialize(raw, one.msgtype).data)
            for one, time_ns, raw in bag.messages()
        ]
    arrays = log.arrays("pid")
    np.testing.assert_array_equal([data for _, data in got], arrays["Y"])
    assert [at for at, _ in got] == (arrays["end_ns"] + log.epoch_ns).tolist()


def test_topics_of_two_tasks_by_a_file(tmp_path, call) -> None:
    written(tmp_path / "r.mcap", tasks=("one",), count=50)
    (tmp_path / "t.toml").write_text(
        'node = "/lab/arm"\n[[publish]]\ntopic = "pose"\nframe = "base"\n'
        'type = "geometry_msgs/msg/PoseStamped"\n'
        'fields = { "pose.position" = "Y[3:6]" }\n'
    )
    words = ("--rosbag2", tmp_path / "bag", "--topics", tmp_path / "t.toml")
    assert call("log", "export", tmp_path / "r.mcap", *words)[0] == 0
    arrays = Log(tmp_path / "r.mcap").arrays("one")
    with reader.AnyReader([tmp_path / "bag"]) as bag:
        found = [bag.deserialize(raw, one.msgtype) for one, _, raw in bag.messages()]
    assert [m.pose.position.z for m in found] == arrays["Y"][:, 5].tolist()
    assert {m.header.frame_id for m in found} == {"base"}
    status, _, told = call("log", "export", tmp_path / "r.mcap", *words)
    assert status == 1
    assert "the bag cannot be written" in told


def test_a_task_is_loaded_once_however_many_topics_it_has(tmp_path) -> None:
    log = Log(written(tmp_path / "r.mcap", tasks=("one", "two"), count=20))
    loads, arrays = [], log.arrays
    log.arrays = lambda task: loads.append(task) or arrays(task)
    topics = Topics(
        publish=[
            Publish(
                topic=f"t{k}",
                type="std_msgs/msg/Float64",
                fields={"data": f"Y[{k}]"},
                max_hz=1.0,
            )
            for k in range(3)
        ]
    )
    counts = rosbag2.export(log, tmp_path / "bag", topics)
    assert sorted(loads) == ["one", "two"]
    assert set(counts.values()) == {40}, "each cycle, whatever max_hz says"
