"""Holds names that only one process of this machine may have at a time."""

import hashlib
import socket


def hold(name: str) -> socket.socket | None:
    """Take a name, and return what holds it until it is closed; None when another one has it.

    The name is that of a socket without a file (Linux): the system gives it back when the process
    ends, however it does, and users of any name see each other's.
    """
    holder = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        # A path may be longer than a socket's name.
        holder.bind(f'\0anser_ros_{hashlib.sha256(name.encode()).hexdigest()}')
    except OSError:
        holder.close()
        return None
    return holder
