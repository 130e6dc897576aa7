from pbonet.outside import Outside as Outside

from ._poses import (
    FrameStep as FrameStep,
    FreeMotion as FreeMotion,
    JointSteps as JointSteps,
    PlaceSteps as PlaceSteps,
    all_finite as all_finite,
    difference as difference,
    fault_of_pose as fault_of_pose,
    is_rotation as is_rotation,
    rotation as rotation,
    turn_of as turn_of,
)
from .arm import SimulatedArm as SimulatedArm
from .blob_detection import NOTHING as NOTHING, Blob as Blob, red_blob as red_blob
from .chain import Chain as Chain
from .collision_model import CollisionModel as CollisionModel
from .floating_model import FloatingModel as FloatingModel
from .magellan import AXES as AXES, Ball as Ball
from .mavlink import MavLink as MavLink
from .mavlink_clock import PeerClock as PeerClock
from .mujoco_camera import MujocoCamera as MujocoCamera
from .mujoco_robot import MujocoRobot as MujocoRobot
from .optional_packages import from_extra as from_extra
from .pinhole import Pinhole as Pinhole, Seen as Seen
from .policy import (
    devices_allowed as devices_allowed,
    no_devices as no_devices,
    require_devices as require_devices,
)
from .puma560 import PUMA560 as PUMA560
from .recorded import RecordedBall as RecordedBall
from .robot_model import RobotModel as RobotModel, find_file as find_file
from .sample_file import Samples as Samples, read_samples as read_samples
from .serial_line import SerialLine as SerialLine, SerialPort as SerialPort
from .space_mouse import SpaceMouse as SpaceMouse
