"""Devices for modules: non-blocking, bounded, with errors that give a remedy.

Everything here may be called inside `cycle`. Nothing in this package waits for a
device, starts a thread, or keeps a clock of its own: a module passes the time to a
device, so that the same code runs in real time, in simulation and in replay. Only
`read_samples` is for `init`: it reads a file.

``serial_line``
    A serial line of the machine, opened and configured by pyserial.
``magellan``
    The six-axis ball on such a line: its protocol, and the ball as a device.
``space_mouse``
    A cap that is pushed and turned, by its reports from the kernel.
``chain``
    Rigid-body mathematics of a serial arm, from its Denavit-Hartenberg table.
``robot_model``
    The same of a robot that a URDF file describes.
``arm``
    An arm that is simulated behind the interface a real one would have.
``puma560``
    The published numbers of the Unimation PUMA 560.
``sample_file``
    Samples of a signal over time, from a file.
``mavlink``
    A MAVLink link; ``mavlink_channels`` carry its bytes, ``mavlink_frames`` finds
    frames in them, ``mavlink_signing`` judges signatures, ``mavlink_messages`` unpacks
    them, and ``mavlink_clock`` knows the time of the other end.
``mujoco_robot``
    A robot that MuJoCo simulates, behind the interface a real one would have.
``mujoco_camera``
    A camera in a scene that MuJoCo draws: for executives only, since drawing takes
    long; ``red_blob`` finds the red thing in its pictures, and ``pinhole`` tells
    where that is.
``optional_packages``
    Packages that only some modules need.
``drivers``
    I/O devices by logical names, with one interface for all drivers.
``policy``
    Whether devices may be opened at all; the simulator says no.
"""

from pbonet.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
