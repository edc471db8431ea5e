"""ROS messages as plain data: codecs and checks that work on any object with the same attributes, without ROS."""
