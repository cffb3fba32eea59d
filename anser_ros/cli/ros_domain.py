"""Keeps simulations on one machine apart: each has a ROS domain of its own while it runs."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from anser_ros.errors import ParameterError
from anser_ros.held_names import hold

VARIABLE = 'ROS_DOMAIN_ID'
LAST_DOMAIN = 101
"""Largest ROS domain used. The ports of domains up to this are no ephemeral ports of Linux."""


@contextmanager
def own_domain(preferred: Iterable[int]) -> Iterator[int]:
    """Name to the nodes to come the first domain that no other simulation has, and hold it.

    Where the environment states one, it is this one or none.

    Raises `ParameterError` when all of them are taken, or the stated one is.
    """
    stated = os.environ.get(VARIABLE, '')
    if stated and not stated.isdecimal():
        raise ParameterError(f'{VARIABLE} must be a number, got {stated!r}')
    for number in [int(stated)] if stated else preferred:
        holder = hold(f'domain {number}')
        if holder is None:
            continue
        os.environ[VARIABLE] = str(number)
        try:
            yield number
        finally:
            holder.close()
            if not stated:
                del os.environ[VARIABLE]
        return
    which = f'{VARIABLE}={stated}' if stated else 'every ROS domain'
    raise ParameterError(
        f'another demo or loop runs in {which}: wait for its end, or state another {VARIABLE}'
    )
