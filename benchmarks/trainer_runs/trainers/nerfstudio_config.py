"""The text of ``config.yml`` as sdfstudio and nerfstudio dump it: Python tags throughout."""

from __future__ import annotations

from typing import Any

_TARGETS = {
    "neus-facto": ("neus_facto.NeuSFactoModelConfig", "neus_facto.NeuSFactoModel"),
    "neus": ("neus.NeuSModelConfig", "neus.NeuSModel"),
    "neus-facto-angelo": ("neus_facto.NeuSFactoModelConfig", "neus_facto.NeuSFactoModel"),
}
_NAMES = {"hash_features_per_level": "features_per_level", "hash_smoothstep": "smoothstep"}
"""What nerfstudio calls some of sdfstudio's settings."""
_SDFSTUDIO_ONLY = {"use_position_encoding", "position_encoding_max_degree"}


def sdfstudio_config(method: str, said: dict[str, Any]) -> str:
    """sdfstudio's, the settings ``said`` in its field."""
    config, target = _TARGETS[method]
    field = {**said, "beta_init": 0.3, "divide_factor": 2.0, "encoding_type": "hash", "off_axis": False}
    return f"""!!python/object:nerfstudio.configs.base_config.Config
data: null
experiment_name: thing
method_name: {method}
optimizers:
  fields:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: &id001 !!python/name:torch.optim.adam.Adam ''
      lr: 0.0005
  proposal_networks:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: *id001
      lr: 0.01
output_dir: !!python/object/apply:pathlib.PosixPath
- outputs
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  datamanager: !!python/object:nerfstudio.data.datamanagers.base_datamanager.VanillaDataManagerConfig
    dataparser: !!python/object:nerfstudio.data.dataparsers.sdfstudio_dataparser.SDFStudioDataParserConfig
      scale_factor: 1.0
    eval_image_indices: !!python/tuple
    - 0
  model: !!python/object:nerfstudio.models.{config}
    _target: !!python/name:nerfstudio.models.{target} ''
    background_model: none
    enable_progressive_hash_encoding: false
    proposal_net_args_list:
    - hidden_dim: 16
      log2_hashmap_size: 17
      max_res: 64
      num_levels: 5
    scene_contraction_norm: inf
    use_average_appearance_embedding: {str(said["use_average_appearance_embedding"]).lower()}
    sdf_field: !!python/object:nerfstudio.fields.sdf_field.SDFFieldConfig
      _target: !!python/name:nerfstudio.fields.sdf_field.SDFField ''
{_lines(field)}
timestamp: 2023-05-01_101500
trainer: !!python/object:nerfstudio.configs.base_config.TrainerConfig
  max_num_iterations: 20001
"""


def nerfstudio_config(method: str, said: dict[str, Any]) -> str:
    """nerfstudio's, the settings ``said`` under its own names."""
    config, target = _TARGETS[method]
    field = {_NAMES.get(key, key): value for key, value in said.items() if key not in _SDFSTUDIO_ONLY}
    field |= {"beta_init": 0.8, "divide_factor": 2.0, "encoding_type": "hash", "use_hash": True}
    return f"""!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: &id001 !!python/name:nerfstudio.engine.trainer.Trainer ''
data: &id002 !!python/object/apply:pathlib.PosixPath
- data
- thing
experiment_name: thing
max_num_iterations: 20001
method_name: {method}
output_dir: !!python/object/apply:pathlib.PosixPath
- outputs
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  _target: !!python/name:nerfstudio.pipelines.base_pipeline.VanillaPipeline ''
  datamanager: !!python/object:nerfstudio.data.datamanagers.base_datamanager.VanillaDataManagerConfig
    data: *id002
    dataparser: !!python/object:nerfstudio.data.dataparsers.sdfstudio_dataparser.SDFStudioDataParserConfig
      auto_orient: true
  model: !!python/object:nerfstudio.models.{config}
    _target: !!python/name:nerfstudio.models.{target} ''
    background_model: none
    use_average_appearance_embedding: {str(said["use_average_appearance_embedding"]).lower()}
    sdf_field: !!python/object:nerfstudio.fields.sdf_field.SDFFieldConfig
      _target: !!python/name:nerfstudio.fields.sdf_field.SDFField ''
{_lines(field)}
timestamp: 2025-08-01_120000
"""


def _lines(values: dict[str, Any]) -> str:
    told = {key: str(value).lower() if isinstance(value, bool) else value for key, value in values.items()}
    return "\n".join(f"      {key}: {told[key]}" for key in sorted(told))
