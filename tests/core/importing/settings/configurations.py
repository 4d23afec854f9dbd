"""Configurations as trainers write them, with their published numbers."""

from __future__ import annotations

import json

NEUS_CONF = """model {{
    sdf_network {{
        d_out = 257
        d_in = 3
        d_hidden = 256
        n_layers = {layers}
        skip_in = [{skip}]
        multires = 6
        bias = 0.5
        scale = {scale}
        geometric_init = True
        weight_norm = True
    }}
}}"""


def nsr(kind: str, more: str = "", network: str = "sphere_init: true") -> str:
    return f"""
model:
  name: neus
  radius: 1.0
  geometry:
    name: volume-sdf
    radius: ${{model.radius}}
    feature_dim: 13
    xyz_encoding_config:
      otype: {kind}
      n_levels: 16
      n_features_per_level: 2
      log2_hashmap_size: 19
      base_resolution: 32
      per_level_scale: 1.3195079107728942
      include_xyz: true
{more}
    mlp_network_config:
      {{otype: VanillaMLP, activation: ReLU, output_activation: none, n_neurons: 64, n_hidden_layers: 1, {network}}}
"""


BAND = "      start_level: 4\n      start_step: 0\n      update_steps: 1000\n"


ANGELO = """
model: {object: {sdf: {
  mlp: {num_layers: 1, hidden_dim: 256, skip: [], activ: softplus, activ_params: {beta: 100}},
  encoding: {type: hashgrid, levels: 16,
    hashgrid: {min_logres: 5, max_logres: 11, dict_size: 22, dim: 8, range: [-2,2]},
    coarse2fine: {enabled: %s, init_active_level: %d, step: 5000}}}}}
optim: {sched: {warm_up_end: 5000}}
data: {readjust: {center: [0.,0.,0.], scale: 2.}}
"""


SPECS = {
    "NetworkArch": "deep_sdf_decoder",
    "NetworkSpecs": {
        "dims": [512] * 8,
        "latent_in": [4],
        "norm_layers": [*range(8)],
        "xyz_in_all": False,
        "use_tanh": False,
    },
    "CodeLength": 256,
}


def studio(theirs: bool, **changed: object) -> str:
    """config.yml with the defaults of neus-facto, by nerfstudio or by sdfstudio."""
    field: dict[str, object] = {"num_layers": 2, "hidden_dim": 256, "use_grid_feature": True, "num_levels": 16}
    field |= {"max_res": 2048, "base_res": 16, "log2_hashmap_size": 19, "encoding_type": "hash"}
    field |= (
        {"features_per_level": 2, "smoothstep": True}
        if theirs
        else {"hash_features_per_level": 2, "hash_smoothstep": True}
    )
    if not theirs:
        field |= {"position_encoding_max_degree": 6, "use_position_encoding": True, "off_axis": False}
    lines = "\n".join(f"      {key}: {json.dumps(value)}" for key, value in (field | changed).items())
    root = "engine.trainer.TrainerConfig" if theirs else "configs.base_config.Config"
    return (
        f"!!python/object:nerfstudio.{root}\nmethod_name: neus-facto\npipeline: !!python/object:a.B\n"
        "  _target: !!python/name:a.b ''\n  datamanager: {dataparser: {auto_orient: false}}\n"
        f"  model: !!python/object:a.C\n    sdf_field: !!python/object:a.D\n{lines}\n"
    )
