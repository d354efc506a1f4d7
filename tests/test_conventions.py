"""The source's frame names are honest (inner names cancel); its public names are documented and annotated."""

import ast
import re
from pathlib import Path

import pytest

import lumidock

FILES = sorted(Path(lumidock.__file__).parent.rglob("*.py"))
TRANSFORM = re.compile(r"_?[TR]_([A-Za-z]+)_([A-Za-z]+)(_|$)")
POINT = re.compile(r"_?p_([a-z]+)(_|$)")
INVERSES = {"se3_inverse", "inv"}
MOTIONS = {"se3_exp", "so3_exp"}  # a small motion within one frame
PASSED_ON = {"asarray", "ascontiguousarray", "array"}


def frames(node):
    """Frames of an expression: (a, b) of a transform, (a,) of points, () of a motion, None when unknown."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name) if name != "T":
            if found := TRANSFORM.match(name):
                return found[1].lower(), found[2].lower()
            return (found[1],) if (found := POINT.match(name)) else None
        case ast.Attribute(value=value):  # .T
            return (found := frames(value)) and found[::-1]
        case ast.Subscript(value=value, slice=ast.Tuple(elts=indices)):
            found = frames(value)
            block = all(isinstance(index, ast.Slice) for index in indices[-2:])  # not the column of a translation
            return found if block or len(found or ()) == 1 else None
        case ast.Subscript(value=value):
            return frames(value)
        case ast.BinOp(left=left, op=ast.MatMult(), right=right):
            return product(frames(left), frames(right))
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[first, *rest]):
            if name in INVERSES:
                return (found := frames(first)) and found[::-1]
            if name == "transform_points" and rest:
                return product(frames(first), frames(rest[0]))
            if name in PASSED_ON:
                return frames(first)
            return () if name in MOTIONS else None
    return None


def product(left, right):
    """Frames of a product; points on the left are rows."""
    if None in (left, right) or (len(left), len(right)) == (1, 1):
        return None
    return (*left[:-1], *right[1:]) if left and right else left or right


def clashes(left, right):
    return bool(left and right) and (len(left), len(right)) != (1, 1) and left[-1] != right[0]


def misnamed(target, value):
    wanted, found = frames(target), frames(value)
    renamed = isinstance(value, ast.Name | ast.Attribute) and len(found or ()) == 1  # p_ may mean a probability
    return bool(wanted and found) and len(wanted) == len(found) and wanted != found and not renamed


def frame_offences(tree):
    """Line and text of each expression whose frame names do not fit together."""
    for node in ast.walk(tree):
        match node:
            case ast.BinOp(left=left, op=ast.MatMult(), right=right):
                wrong = clashes(frames(left), frames(right))
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[left, right]):
                wrong = name == "transform_points" and clashes(frames(left), frames(right))
            case ast.Assign(targets=targets, value=value):
                wrong = any(misnamed(target, value) for target in targets)
            case ast.AnnAssign(target=target, value=value) | ast.NamedExpr(target=target, value=value):
                wrong = misnamed(target, value)
            case ast.keyword(arg=str(name), value=value):
                wrong = misnamed(ast.Name(name), value)
            case _:
                continue
        if wrong:
            yield f"line {node.lineno}: {ast.unparse(node)}"


def public_offences(body, *, methods=False):
    """Line and name of each public function, class or method without docstring or annotation."""
    for node in body:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) or node.name.startswith("_"):
            continue
        if ast.get_docstring(node) is None:
            yield f"line {node.lineno}: {node.name} has no docstring"
        if isinstance(node, ast.ClassDef):
            yield from public_offences(node.body, methods=True)
            continue
        bound = methods and not any(isinstance(d, ast.Name) and d.id == "staticmethod" for d in node.decorator_list)
        named = [*node.args.posonlyargs, *node.args.args][bound:]
        arguments = [*named, *node.args.kwonlyargs, *filter(None, [node.args.vararg, node.args.kwarg])]
        if node.returns is None or any(argument.annotation is None for argument in arguments):
            yield f"line {node.lineno}: {node.name} is not fully annotated"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(FILES[0].parent)))
def test_the_source_keeps_the_conventions(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert [*frame_offences(tree), *public_offences(tree.body)] == []


@pytest.mark.parametrize(
    "source",
    [
        "T_dock_cam @ T_body_cam",
        "R_dock_cam @ R_body_cam",
        "T_dock_cam_prior @ track.T_dock_cam",
        "T_a_b @ T_b_c @ T_b_d",
        "T_dock_cam @ se3_inverse(T_cam_body)",
        "T_dock_cam[:3, :3] @ R_cam_dock.T",
        "T_dock_cam @ se3_exp(xi) @ T_dock_body",
        "R_DOCK_CAM_HEAD_ON @ R_dock_cam",
        "T_dock_cam @ p_dock",
        "p_cam @ R_dock_cam",
        "p_cam @ R_cam_dock.T",
        "p_dock = T_cam_dock @ p_cam",
        "p_dock = T_cam_dock @ p_dock",
        "p_dock_near = T_cam_dock[i] @ p_dock[0]",
        "p_dock = p_dock @ R_dock_cam",
        "transform_points(T_dock_cam, p_dock)",
        "geometry.transform_points(se3_inverse(T_dock_cam), p_cam)",
        "p_dock = transform_points(T_cam_dock, p_dock)",
        "p_cam = np.asarray(transform_points(T_dock_cam, p_cam))",
        "T_dock_cam = se3_inverse(T_dock_cam)",
        "self.T_dock_cam = np.linalg.inv(T_dock_cam)",
        "T_cam_dock: Array = T_dock_body @ T_body_cam",
        "T_dock_cam = T_cam_dock",
        "T_dock_cam = T_cam_dock @ se3_exp(xi)",
        "T_dock_cam[:3, :3] = R_cam_dock",
        "R_dock_cam = T_cam_dock[:3, :3]",
        "Fix(T_dock_cam=se3_inverse(T_dock_cam))",
        "f(T_dock_cam := T_cam_dock)",
    ],
)
def test_dishonest_frames_are_caught(source):
    assert list(frame_offences(ast.parse(source)))


@pytest.mark.parametrize(
    "source",
    [
        "T_dock_body = T_dock_cam @ T_cam_body",
        "T_dock_cam_next = track.T_dock_cam @ se3_exp(track.twist * dt)",
        "T_cam_dock = se3_inverse(T_dock_cam_prior)",
        "p_dock = T_dock_cam @ p_cam",
        "p_cam = p_dock[named] @ T_dock_cam[:3, :3]",
        "p_dock = p_cam @ R_dock_cam.T",
        "p_cam = transform_points(se3_inverse(T_dock_cam), station.p_dock)",
        "p_dock_origin = T_dock_cam[:3, 3]",
        "T_dock_cam[:3, 3] = p_dock",
        "T_dock_cam[:, :3, :3] = [R_dock_cam @ so3_exp(w) for w in turn]",
        "J_uv_p @ J_p_pose",
        "A @ cov @ A.T",
        "p_rear = p_light",
    ],
)
def test_honest_frames_pass(source):
    assert list(frame_offences(ast.parse(source))) == []


@pytest.mark.parametrize(
    ("source", "offences"),
    [
        ("def f(x: int) -> int:\n  'Doc.'", 0),
        ("def f(x: int) -> int: ...", 1),
        ("def f(x) -> int:\n  'Doc.'", 1),
        ("def f(*, x) -> int:\n  'Doc.'", 1),
        ("def f(*x) -> int:\n  'Doc.'", 1),
        ("def f(**x) -> int:\n  'Doc.'", 1),
        ("async def f(x: int):\n  'Doc.'", 1),
        ("def f(x): ...", 2),
        ("def _f(x): ...", 0),
        ("class C: ...", 1),
        ("class C:\n  'Doc.'\n  def f(self) -> int:\n    'Doc.'", 0),
        ("class C:\n  'Doc.'\n  def f(self) -> int: ...", 1),
        ("class C:\n  'Doc.'\n  def f(self):\n    'Doc.'", 1),
        ("class C:\n  'Doc.'\n  @staticmethod\n  def f(x) -> int:\n    'Doc.'", 1),
        ("class C:\n  'Doc.'\n  def __len__(self): ...", 0),
        ("class _C:\n  def f(self): ...", 0),
    ],
)
def test_public_offences_are_counted(source, offences):
    assert len(list(public_offences(ast.parse(source).body))) == offences
