"""What an agent says of its machine's memory."""

import errno

from pbonet.node.agent import machine_state
from pbonet.node.agent.machine_state import copy_speed


def test_the_speed_of_memory_is_measured_once():
    """No bound is exact: a memory moves 100 MB to 1 TB a second."""
    copy_speed.cache_clear()
    speed = copy_speed()
    assert 1e8 <= speed <= 1e12
    assert copy_speed() is speed


def test_a_folder_is_lost_when_it_is_removed_or_made_again_not_when_unreadable(
    tmp_path, monkeypatch
):
    folder = tmp_path / "run"
    folder.mkdir()
    folders = machine_state.NeededFolders(folder)
    assert folders.lost() == ""

    def fail(*_, **__):
        raise OSError(errno.ENOMEM, "no memory")

    with monkeypatch.context() as patched:
        patched.setattr(type(folder), "stat", fail)
        assert folders.lost() == ""
    folder.rename(tmp_path / "old")
    folder.mkdir()
    assert f"{folder} was removed" in folders.lost()
    folder.rmdir()
    assert "set PBONET_RUN_DIR" in folders.lost()
