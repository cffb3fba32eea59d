"""Keeps the memory of a node that runs for days from breaking into pieces.

glibc gives blocks of 128 KiB and more back to the system when they are freed, but raises this
bound to the size of the largest block that was freed so far, up to 32 MiB, and gives each thread a
heap of its own. Tables of tens of megabytes then lie among small blocks that stay, and leave
holes, and every heap keeps the most that its thread ever held: `field_model` had 612 MB after
twenty minutes, in steps of megabytes, and has 511 so.
"""

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Parameters of glibc's ``mallopt``, as <malloc.h> numbers them."""
LARGE = 4 * 1024 * 1024
"""Bytes from which on a block has pages of its own, which are given back. What is made for a frame
is smaller: with 256 KiB, `field_model` asks for 9000 pages a second and waits for them."""
MOST_FREE = 64 * 1024 * 1024
"""Free bytes at the end of the heap that are kept, as many as glibc itself comes to keep; with
8 MiB the same node still asks for 3000 pages a second."""


def keep_in_one_piece() -> None:
    """Set the allocator of this process so; do nothing where it is not glibc's."""
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    set_option(M_ARENA_MAX, 1)
    set_option(M_MMAP_THRESHOLD, LARGE)
    set_option(M_TRIM_THRESHOLD, MOST_FREE)
