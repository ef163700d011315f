"""What looks like this: ``shadowhound-data lake embed`` makes vectors of pictures, and ``query --like`` asks by them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from shadowhound_data_logger.cli.common import BadUsage, ExitCode, as_json, examples, exit_code, the_store, the_store_settings
from shadowhound_data_logger.cli.output import counted, duration, number, plain, print_json, print_page
from shadowhound_data_logger.cli.progress import progress
from shadowhound_data_logger.cli.question import asking, question, quietly, report_skipped

if TYPE_CHECKING:
    from shadowhound_data_logger.lake.findings import Findings
    from shadowhound_data_logger.lake.image_models import OnnxPair
    from shadowhound_data_logger.lake.likeness import Embedded

REASONS: Final = {
    'missing': 'not in the store any more', 'too_large': 'too large', 'changed': 'content differs from the catalog',
    'unreadable': 'no JPEG, PNG or TIFF that can be decoded, or the model makes no vector of it',
}  # fmt: skip
model_option = click.option(
    '--model', type=click.Path(path_type=Path, exists=True, file_okay=False), metavar='DIR',
    help='Folder with the ONNX models of images and text, such as CLIP.',
)  # fmt: skip


@click.command('embed', epilog=examples('lake embed --model clip-vit-base-patch32 --sensor camera --since 7d'))
@question
@model_option
@as_json
def lake_embed(*, flags: Mapping[str, Any], model: Path | None, as_json: bool) -> ExitCode:
    """Make vectors of images for `query --like`.

    It embeds all images that the flags select and that have no vector of this model yet. The vectors are stored in
    sensor-data/_vectors/: run it again when there are new images, or after an interruption.

    A model is a folder with vision_model.onnx and, for --like-text, text_model.onnx and tokenizer.json, as Hugging Face
    exports CLIP and SigLIP.

    Exit code 1 if images could not be read.
    """
    begun_s = time.monotonic()
    with asking():
        from shadowhound_data_logger.lake import likeness  # noqa: PLC0415 - the extra lake
        from shadowhound_data_logger.lake.bucket import default_source  # noqa: PLC0415
        from shadowhound_data_logger.lake.names import check_names  # noqa: PLC0415

        chosen, left_out = _opened(model), quietly()
        with the_store() as store, progress('pictures', of='objects') as bar:
            source = default_source(the_store_settings())
            found = likeness.embed(store, source, chosen, findings=left_out, progress=bar, **flags)
        if not found.pictures:
            check_names(source, left_out, **flags)
    took_s = time.monotonic() - begun_s
    if as_json:
        print_json({'model': chosen.digest, 'pictures': found.pictures, 'known': found.known, 'made': found.made,
                    'refused': dict(found.refused), 'took_s': round(took_s, 3)})  # fmt: skip
    else:
        print_page(*_summary(found, chosen.name, took_s))
    return report_skipped(left_out) or exit_code(finding=bool(found.refused))


def _summary(found: Embedded, name: str, took_s: float) -> Iterator[Any]:
    yield plain(f'{counted(found.made, "vector")} made by {name} in {duration(took_s)}; {number(found.known)} of '
                f'{counted(found.pictures, "picture")} had one.')  # fmt: skip
    for reason, count in sorted(found.refused.items()):
        yield plain(f'{counted(count, "picture")} without one: {REASONS[reason]}.', 'yellow')


def most_similar(source: Any, like: Path | None, text: str | None, folder: Path | None, limit: int, left_out: Findings,
           flags: Mapping[str, Any]) -> Any:  # fmt: skip
    """The rows of the most similar pictures, with their similarity; objects without a vector are reported on standard error."""
    from shadowhound_data_logger.core.untrusted import open_image  # noqa: PLC0415
    from shadowhound_data_logger.lake import likeness  # noqa: PLC0415 - the extra lake

    model = _opened(folder)
    try:
        if like is not None:
            with open_image(like) as opened:
                wanted = model.embed_images([opened])[0]
        else:
            wanted = model.embed_text(text or '')
    except (OSError, ValueError, SyntaxError) as error:
        raise BadUsage(f'{like or "the text"} cannot be compared: {error}', 'a JPEG, PNG or TIFF is a picture') from error
    found = likeness.like(source, model, wanted, limit=limit, findings=left_out, **flags)
    if found.without:
        missing = f'{number(found.without)} of {counted(found.pictures, "picture")} have no vector by {model.name}'
        click.echo(f'{missing}: shadowhound-data lake embed --model {folder} makes them', err=True)
    return found.rows


def _opened(folder: Path | None) -> OnnxPair:
    from shadowhound_data_logger.lake.image_models import LAYOUT, OnnxPair  # noqa: PLC0415 - the extra lake

    if folder is None:
        raise BadUsage('images are compared by a model', f'--model DIR: {LAYOUT}')
    return OnnxPair.open(folder)
