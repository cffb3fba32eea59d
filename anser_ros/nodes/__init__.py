"""Holds the ROS 2 nodes: the only place that knows rclpy and the message packages.

A file here is a program; what it is made of stands in the room NODE_parts, what every node runs in
in ``runtime``, and what several nodes receive or send in ``streams``.
"""
