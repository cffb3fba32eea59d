"""Serves the live view's page in the browser, without ROS: layout, jobs, files, who may look."""
