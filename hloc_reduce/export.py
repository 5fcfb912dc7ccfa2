"""Write a network's features, a projection, or LightGlue for a feature, as an ONNX file.

Programs without Python run it by ONNX Runtime or TensorRT: docs/export.md.
"""

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from . import __version__, logger, projections
from .confs import features as features_confs
from .confs import matchers as matchers_confs
from .networks.lightglue import identity
from .utils import cli, options
from .utils.cli import InputError
from .utils.files import replacing
from .utils.options import Option
from .utils.paths import strings_as_paths

if TYPE_CHECKING:
    import torch

OPSET = 18
ONNX_TOLERANCE = 1e-4  # between ONNX Runtime and torch
PACKAGES = ("onnx", "onnxruntime", "onnxscript")
# images of these sides, in strides, make the graph and check it
MADE_WITH, CHECKED_WITH = (3, 4), (8, 11)
MATCHERS = ("lightglue",)


@dataclass(frozen=True)
class Content:
    """What a file holds, and what it is checked with.

    Args:
        module: computes the outputs from the inputs.
        inputs: their shapes by name; strings are dynamic.
        outputs: the same of the outputs.
        stride: what the dynamic sides of the inputs are multiples of.
        made_with: inputs to trace the module with.
        checked_with: inputs of another size.
        expected: the outputs for `checked_with`.
        metadata: of the file.
    """

    module: "torch.nn.Module"
    inputs: dict[str, tuple[int | str, ...]]
    outputs: dict[str, tuple[int | str, ...]]
    stride: int
    made_with: "tuple[torch.Tensor, ...]"
    checked_with: "tuple[torch.Tensor, ...]"
    expected: "tuple[torch.Tensor, ...]"
    metadata: dict[str, str]


@strings_as_paths
def main(
    feature: str,
    output: Path,
    projection: Path | None = None,
    projection_only: bool = False,
    matcher: Annotated[str, Option("matcher", MATCHERS)] | None = None,
) -> Path:
    """Write an ONNX file and check that ONNX Runtime computes the same with it as torch.

    Args:
        feature: feature, see pipelines.aachen --list_features, or its YAML file.
        output: the ONNX file.
        projection: file of another projection of the feature's descriptors.
        projection_only: write the projection alone, from descriptors to fewer dimensions, which
            every feature that has one can do.
        matcher: write this matcher for the feature instead.

    Returns:
        `output`.

    Raises:
        InputError: when the feature is unknown or cannot be written, its weights are missing, a
            package is not installed, or the two compute different features.
    """
    if output.suffix != ".onnx":
        raise InputError(f"--output {output}: the name of an ONNX file ends with .onnx.")
    cli.check_file(output)
    if missing := [package for package in PACKAGES if find_spec(package) is None]:
        raise InputError(
            f"An export needs {', '.join(missing)}: pip install 'hloc-reduce[export]'."
        )
    name, conf = features_confs.get(feature, projection)
    if matcher and projection_only:
        raise InputError("Give --matcher or --projection_only, not both.")
    content = (_matcher if matcher else _projection if projection_only else _network)(name, conf)
    content.metadata.update(feature=name, hloc_reduce=__version__)
    with replacing(output) as temporary:
        _write(content, temporary)
        difference = _check(content, temporary)
    logger.info(
        "Wrote %s (%.1f MB). ONNX Runtime and torch agree on %d %s: at most %.0e apart.",
        output,
        output.stat().st_size / 1e6,
        len(content.expected[-1]),
        "scores of matches" if matcher else "descriptors",
        difference,
    )
    return output


def _projection(name: str, conf: dict) -> Content:
    """Return the content of a projection's file."""
    import torch

    projection = conf["model"].get("projection")
    if projection is None:
        raise InputError(
            f"{name} has no projection: --projection_only needs a feature that has one."
        )
    project = projections.load(projection)
    generator = torch.Generator().manual_seed(0)
    made_with, checked_with = (
        torch.nn.functional.normalize(
            torch.randn(number, project.sizes[0], generator=generator), dim=1
        )
        for number in (10, 1000)
    )
    return Content(
        project,
        {"descriptors": ("N", project.sizes[0])},
        {"reduced": ("N", project.dim)},
        1,
        (made_with,),
        (checked_with,),
        (project(checked_with),),
        {"dim": str(project.dim), "left_out": "keypoints and their descriptors before projection"},
    )


def _network(name: str, conf: dict) -> Content:
    """Return the content of a whole feature's file: an extractor, and its projection if any."""
    import torch

    from . import extractors

    if features_confs.network_of(conf["model"]) is None:
        kind = features_confs.base_of(conf["model"])["name"]
        raise InputError(
            f"{name} has the keypoints of {'DoG' if kind == 'dog' else kind}, but only features of "
            f"{', '.join(features_confs.DEFAULT_NETWORKS)} can be exported as a whole. Export a "
            "projection alone with --projection_only."
        )
    extractor = extractors.load(conf["model"]).eval()
    settings, stride = extractor.base.conf, extractor.base.stride
    number, longest = settings["max_keypoints"], conf["preprocessing"]["resize_max"]
    if conf["preprocessing"]["grayscale"]:
        raise InputError(
            f"{name} takes gray images, but exported files take RGB. Write grayscale: false."
        )
    if number < 1:
        raise InputError(f"{name}: ONNX needs max_keypoints of at least 1, not {number}.")
    left_out = [f"resizing to at most {longest} pixels"] if longest else []
    left_out += ["noise reduction"] if settings["denoise"] else []
    settings["denoise"] = False
    image = _image(*(side * stride for side in CHECKED_WITH))
    with torch.no_grad():
        features = extractor({"image": image})
    if not features["scores"].numel():
        raise InputError(f"{name} finds no keypoints to check the file with: lower its threshold.")
    return Content(
        extractors.Graph(extractor),
        {"image": (1, 3, "height", "width")},
        {
            "keypoints": ("N", 2),
            "scores": ("N",),
            "descriptors": ("N", extractor.dim),
        },
        stride,
        (_image(*(side * stride for side in MADE_WITH)),),
        (image,),
        (features["keypoints"][0], features["scores"][0], features["descriptors"][0].T),
        {
            "dim": str(extractor.dim),
            "stride": str(stride),
            "max_keypoints": str(number),
            "left_out": ", ".join(left_out),
        },
    )


def _matcher(name: str, conf: dict) -> Content:
    """Return the content of the file of LightGlue for a feature."""
    import torch

    from . import extract_features, extractors
    from .matchers.lightglue import Graph, LightGlue

    made_from = extract_features.provenance(conf)
    model = matchers_confs.for_features(matchers_confs.confs["lightglue"]["model"], made_from)
    graph = Graph(LightGlue(model).eval())
    dim, extractor = graph.dim, extractors.load(conf["model"]).eval()
    picture = (255 * _image(512, 640)[0]).byte().permute(1, 2, 0).numpy()
    # of two sizes: of equal tensors the export keeps one, for both photos
    found = [
        extractors.extract(extractor, np.ascontiguousarray(photo), conf["preprocessing"])
        for photo in (picture, picture[32:, 64:])
    ]

    def inputs(*numbers: int) -> tuple[torch.Tensor, ...]:
        """Return some features of a picture and of a part of it."""
        return tuple(
            torch.from_numpy(np.ascontiguousarray(part)).float()
            for number, one in zip(numbers, found, strict=True)
            for part in (
                one["keypoints"][:number],
                one["descriptors"].T[:number],
                one["image_size"],
            )
        )

    checked_with = inputs(300, 200)
    with torch.no_grad():
        expected = graph(*checked_with)
    assert (expected[0] >= 0).any()
    return Content(
        graph,
        {
            f"{key}{i}": shape
            for i in (0, 1)
            for key, shape in (
                ("keypoints", (f"N{i}", 2)),
                ("descriptors", (f"N{i}", dim)),
                ("image_size", (2,)),
            )
        },
        {"matches0": ("N0",), "matching_scores0": ("N0",)},
        1,
        inputs(20, 30),
        checked_with,
        expected,
        {
            "matcher": "lightglue",
            "dim": str(dim),
            "made_from": json.dumps(identity(made_from)),
            "max_keypoints": str(model["max_keypoints"]),
            "left_out": "early exit and pruning",
        },
    )


def _image(height: int, width: int) -> "torch.Tensor":
    """Return an image (1, 3, H, W) float32 in [0, 1] of blobs of several sizes."""
    import torch
    from torch.nn.functional import interpolate

    generator, image = torch.Generator().manual_seed(0), torch.full((1, 3, height, width), 0.5)
    for side in (2, 4, 8, 16):
        noise = torch.randn(1, 3, height // side, width // side, generator=generator)
        image += 0.1 * interpolate(noise, (height, width), mode="bicubic")
    return image.clamp(0, 1)


def _write(content: Content, path: Path) -> None:
    """Write an ONNX file; it computes in float32."""
    import torch
    from onnx_ir import Shape
    from onnx_ir.passes.common import ClearMetadataAndDocStringPass

    from .projections.network import Projection

    named = {
        side: content.stride * torch.export.Dim(f"{side}_in_strides")
        for shape in content.inputs.values()
        for side in shape
        if isinstance(side, str)
    }
    sides = tuple(
        {axis: named[side] for axis, side in enumerate(shape) if isinstance(side, str)}
        for shape in content.inputs.values()
    )
    for module in content.module.modules():
        if isinstance(module, Projection):
            module.exact = False
    with _quiet(), torch.no_grad():
        traced = torch.export.export(
            content.module, content.made_with, dynamic_shapes=sides, strict=False
        )
        program = torch.onnx.export(traced, dynamo=True, opset_version=OPSET, verbose=False)
    assert program is not None  # it is only without dynamo
    model = program.model
    ClearMetadataAndDocStringPass()(model)  # stack traces, with names of folders
    values = (*model.graph.inputs, *model.graph.outputs)
    for value, (name, shape) in zip(
        values, (content.inputs | content.outputs).items(), strict=True
    ):
        value.name, value.shape = name, Shape(shape)
    model.producer_name, model.producer_version = "hloc-reduce", __version__
    model.metadata_props.update(content.metadata)
    program.save(path, external_data=False)


def _check(content: Content, path: Path) -> float:
    """Return the greatest difference between ONNX Runtime and torch; of scores, the relative one.

    Raises:
        InputError: when it is above `ONNX_TOLERANCE`, or the keypoints are others.
    """
    import onnxruntime
    import torch

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = list(content.outputs)
    given = zip(content.inputs, content.checked_with, strict=True)
    outputs = session.run(names, {name: tensor.numpy() for name, tensor in given})
    found = [torch.from_numpy(x) for x in outputs]
    difference = float("inf")
    if [x.shape for x in found] == [x.shape for x in content.expected]:
        if "keypoints" in names:  # those of equal scores are in any order
            order = torch.cdist(content.expected[0].double(), found[0].double()).argmin(dim=1)
            found = [x[order] for x in found]
        errors = [(a - b).abs() for a, b in zip(found, content.expected, strict=True)]
        if "scores" in names:  # may be logits of any size
            errors[1] /= 1 + content.expected[1].abs()
        difference = max((float(error.max()) for error in errors if error.numel()), default=0.0)
    if not difference <= ONNX_TOLERANCE:
        raise InputError(
            f"ONNX Runtime does not compute what torch computes: they differ by {difference:.0e} "
            f"instead of at most {ONNX_TOLERANCE:.0e}. No file was written. Try the versions of "
            "onnx, onnxruntime, onnxscript and torch in constraints.txt."
        )
    return difference


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence what torch says about packages that the export does not need."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _main() -> None:
    options.call(main, __doc__, "--feature edgepoint2_m32 --output edgepoint2_m32.onnx")


if __name__ == "__main__":
    cli.run(_main)
