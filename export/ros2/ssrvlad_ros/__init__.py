"""Loop closures from label images in ROS 2; `loop_node` is the only module that imports ROS."""
