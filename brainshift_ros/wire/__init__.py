"""ROS messages as plain data: codecs and checks that work on any object with the same attributes, without ROS.

Decoders take a message (of rclpy, of rosbags, of a test) and return a type of the core, or raise
:class:`~brainshift_ros.errors.InputError` that names the topic. Encoders return a :data:`~brainshift_ros.wire.plain.Plain`
mapping, which `nodes/messages.py` turns into an rclpy message and `bags.py` into a recorded one.
"""
