"""What an agent tells of its machine's clock and disk."""

import shutil
import time

from pbonet.node.agent.machine_state import machine_info


def test_the_disk_of_a_folder_that_is_not_there_yet(tmp_path):
    begin = time.time()
    told = machine_info(str(tmp_path / "runs" / "deep"))
    assert told.runs == str(tmp_path / "runs" / "deep")
    assert told.disk_size == shutil.disk_usage(tmp_path).total
    assert begin <= told.wall <= time.time()
