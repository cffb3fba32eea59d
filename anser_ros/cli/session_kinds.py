"""Finds what takes a session: a module of `commands.SESSION_KINDS`, or a model for its fluxes."""

import argparse
import importlib
from types import ModuleType

from anser_ros.cli.commands import SESSION_KINDS
from anser_ros.errors import ParameterError
from anser_ros.field.model import FieldModel
from anser_ros.sessions.model_file import SNAPSHOT, is_snapshot


def add_session_kinds(parser: argparse.ArgumentParser) -> None:
    """Declare an option for each kind of session, and the options that it has."""
    for name, (module, line) in SESSION_KINDS.items():
        parser.add_argument(f'--{name}', action='store_true', help=line)
        importlib.import_module(module).add_options(parser)


def named_kind(args: argparse.Namespace) -> ModuleType | None:
    """Return the module of the kind of session that the options name, None for one of fluxes."""
    for name, (module, _) in SESSION_KINDS.items():
        if getattr(args, name):
            return importlib.import_module(module)
    return None


def need_model(args: argparse.Namespace) -> None:
    """Raise `ParameterError` where a session of fluxes has no model."""
    if args.model is None:
        kinds = ', '.join(f'--{name}' for name in SESSION_KINDS)
        raise ParameterError(f'the following arguments are required: --model (or {kinds})')


def snapshot_notes(name: str, model: FieldModel) -> tuple[str, ...]:
    """Report that a command works with a snapshot of a refit, where it does."""
    return (f'{name} is a {SNAPSHOT}, not a calibration',) if is_snapshot(model) else ()
