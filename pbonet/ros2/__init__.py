"""ROS 2 without ROS: topics, services and bags, in the format of rmw_zenoh.

A subsystem is a node of a ROS 2 system. Its process, `pbonet ros2 bridge`, is outside
of every task: it reads the table as `display` does, and writes links, which tasks read
as those of any other subsystem.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
