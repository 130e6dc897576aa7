from . import bridge as bridge, rosbag2 as rosbag2, topics_file as topics_file
