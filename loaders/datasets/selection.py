"""Which of the models that were found are asked for? Scenes and components by glob, or by a list in a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from fnmatch import fnmatchcase
from pathlib import Path

from sfm_audit.loaders.datasets.discover import Discovery, ModelRef, in_order
from sfm_audit.loaders.errors import LoadError, MalformedFileError, MissingFileError, Position
from sfm_audit.loaders.paths.files import read_bytes

_EXAMPLES = 3
_MAX_COMPARED = 200  # characters of a name: difflib takes the product of both lengths
_MAX_NAMES = 2_000


@dataclass(frozen=True, slots=True)
class SceneList:
    """The names in a file: one per line, ``scene`` or ``scene/component``; blank lines and # comments are skipped.

    names: line numbers, from 1, by name.
    """

    path: str
    names: dict[str, int]


@dataclass(frozen=True, slots=True)
class Selection:
    """The models asked for; an empty field asks for all. Globs know ``*``, ``?`` and ``[...]``; * crosses a /."""

    scenes: tuple[str, ...] = ()
    components: tuple[str, ...] = ()
    lists: tuple[SceneList, ...] = ()


def read_scene_list(path: Path) -> SceneList:
    """Read a list of scenes.

    Raises
    ------
    LoadError
        The file cannot be read, is no text, or names nothing.
    """
    try:
        lines = read_bytes(path).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        got, advice = f"bytes that are not UTF-8 ({error.reason})", "write one scene per line"
        raise MalformedFileError(str(path), Position("byte", error.start), "text", got, advice) from error
    stripped = ((number, line.strip()) for number, line in enumerate(lines, start=1))
    names = {line: number for number, line in stripped if line and not line.startswith("#")}
    if not names:
        raise MalformedFileError(str(path), None, "names of scenes", "none", "write one scene per line")
    return SceneList(str(path), names)


def select(found: Discovery, wanted: Selection) -> Discovery:
    """Return the models that are asked for; the others are left out.

    A glob or a name that fits no model becomes an entry of ``errors``, named as ``--scene`` and the like.
    """
    chosen = [ref for ref in found.refs if _fits(ref, wanted)]
    keys = {ref.location for ref in chosen}
    rest = (ref for ref in found.refs if ref.location not in keys)
    errors = (*found.errors, *_unknown(found.refs, wanted))
    if found.refs and not chosen and len(errors) == len(found.errors):
        got = f"none of the {len(found.refs)} models fits all of them"
        errors += (LoadError("--scene, --component, --scene-list", None, "models", got, "see --list"),)
    return replace(found, refs=tuple(chosen), errors=errors, left_out=in_order([*found.left_out, *rest]))


def _fits(ref: ModelRef, wanted: Selection) -> bool:
    is_scene = not (wanted.scenes or wanted.lists)
    is_scene = is_scene or any(fnmatchcase(ref.scene, glob) for glob in wanted.scenes)
    is_scene = is_scene or any(name in each.names for each in wanted.lists for name in _names(ref))
    return is_scene and (not wanted.components or any(fnmatchcase(ref.component, glob) for glob in wanted.components))


def _names(ref: ModelRef) -> tuple[str, str]:
    return ref.scene, f"{ref.scene}/{ref.component}"


def _unknown(refs: Sequence[ModelRef], wanted: Selection) -> list[LoadError]:
    if not refs:
        return []
    scenes, components = {ref.scene for ref in refs}, {ref.component for ref in refs}
    problems = [_no_match("--scene", glob, scenes) for glob in wanted.scenes if not _any_fits(scenes, glob)]
    problems += [
        _no_match("--component", glob, components) for glob in wanted.components if not _any_fits(components, glob)
    ]
    known = {name for ref in refs for name in _names(ref)}
    for each in wanted.lists:
        missing = [name for name in each.names if name not in known]
        if missing:
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            position = Position("line", each.names[missing[0]])
            close = _closest(missing[0], known)
            got = f"{missing[0]!r}{more}, not below these PATHs"
            advice = "remove the name, or add the PATH that holds it"
            if close:
                advice = f"did you mean {close!r}? Otherwise {advice}"
            problems.append(MissingFileError(each.path, position, "scenes of these PATHs", got, advice))
    return problems


def _any_fits(names: Iterable[str], glob: str) -> bool:
    return any(fnmatchcase(name, glob) for name in names)


def _no_match(option: str, glob: str, names: set[str]) -> LoadError:
    examples = ", ".join(sorted(names)[:_EXAMPLES])
    got = f"{len(names)} others ({examples}{', ...' if len(names) > _EXAMPLES else ''})"
    close = _closest(glob, names)
    advice = f"did you mean {close!r}? See --list" if close else "see --list"
    return LoadError(f"{option} {glob!r}", None, "a name that fits", got, advice)


def _closest(word: str, names: Iterable[str]) -> str | None:
    """Return the name that was probably meant."""
    if len(word) > _MAX_COMPARED:
        return None
    known = sorted(names)[:_MAX_NAMES]
    same = [name for name in known if name.casefold() == word.casefold()]
    return next(iter(same or get_close_matches(word, known, n=1)), None)
