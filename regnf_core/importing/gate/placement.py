"""The dataset's frame: a field that was converted in its own is placed by the transform its trainer applied, undone."""

from __future__ import annotations

from dataclasses import replace

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.similarity import moved_box, product, shift_rows


def placed(converted: ConvertedField, description: UploadDescription) -> ConvertedField:
    """``converted`` in the frame that the description asks for, and in ``why`` whether the dataset's is known.

    Raises FieldFormatError (INVALID_DESCRIPTION) where the dataset's frame is asked for and not known.
    """
    rows = description.dataset_transform
    if rows is None:
        if description.frame == "dataset":
            message = (
                "description.frame: the dataset's frame is not known; put the file that says it into the run's folder,"
                " dataparser_transforms.json (nerfstudio) or the dataset's meta_data.json (sdfstudio), or give"
                " dataset_transform"
            )
            raise FieldFormatError(message, reason="INVALID_DESCRIPTION")
        return converted
    a, b, c = rows[0][:3]
    unit = (a * a + b * b + c * c) ** 0.5
    if description.frame != "dataset":
        why = f"the dataset's frame is known, one unit of the field is {unit:g} of it: say frame dataset to have it"
        return replace(converted, why=(*converted.why, why))
    # world_scale is the length of the dataset's unit then: it scales the shift, as it has scaled the field.
    scale = description.world_scale or 1.0
    transform = [[*row[:3], scale * row[3]] for row in rows[:3]] + [rows[3]]
    bounds = converted.description["bounds"]
    before = converted.description.get("placement") or {"transform": shift_rows((0.0, 0.0, 0.0)), "bounds": bounds}
    placement = {"transform": product(transform, before["transform"]), "bounds": before["bounds"]}
    changed = converted.description | {"bounds": moved_box(transform, bounds), "placement": placement}
    why = f"in the dataset's frame: one unit of the network's coordinates is {unit:g} of the dataset's"
    return replace(converted, description=changed, why=(*converted.why, why))
