"""Filters on the Hugging Face Hub, where ``huggingface_hub`` is installed: ``pip install 'torch_denkf[hub]'``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torch_denkf import _registered
from torch_denkf.deployment.folder import read_folder_config
from torch_denkf.filters import Filter
from torch_denkf.pretrained.folders import from_pretrained, save_pretrained

try:
    from huggingface_hub import ModelHubMixin, snapshot_download
except ImportError:

    class ModelHubMixin:  # type: ignore[no-redef]
        """In the mixin's place where it is not installed."""

        def __init_subclass__(cls, **_: Any):
            """Takes the mixin's options."""

        def __new__(cls, *_: Any, **__: Any):
            """Says what is missing."""
            raise ImportError(f"{cls.__name__} needs huggingface_hub: pip install 'torch_denkf[hub]'")

        from_pretrained = classmethod(__new__)


__all__ = ["HubFilter"]


class HubFilter(ModelHubMixin, tags=["torch_denkf", "robotics"]):
    """A filter with ``push_to_hub``, ``save_pretrained`` and ``from_pretrained`` of ``huggingface_hub``'s mixin.

    The files are those of :func:`~torch_denkf.pretrained.save_pretrained`: data only, with a checksum.

    Args:
        filter: the filter, then in :attr:`filter`.
        builder: see :func:`~torch_denkf.pretrained.save_pretrained`, as ``settings`` and ``card``.
        settings: likewise.
        card: text of ``card.md``.
    """

    def __init__(
        self,
        filter: Filter,
        *,
        builder: Callable[..., Filter] | None = None,
        settings: Mapping[str, Any] | None = None,
        card: str | None = None,
    ):
        self.filter, self.builder, self.settings, self.card = filter, builder, settings, card

    def _save_pretrained(self, save_directory: Path) -> None:
        save_pretrained(self.filter, save_directory, builder=self.builder, settings=self.settings, card=self.card)

    @classmethod
    def _from_pretrained(
        cls,
        *,
        model_id: str,
        builders: Mapping[str, Callable[..., Filter]] | None = None,
        **options: Any,
    ) -> HubFilter:
        """From a folder, or from the Hub; ``builders`` as of :func:`~torch_denkf.pretrained.from_pretrained`."""
        known = ("revision", "cache_dir", "force_download", "local_files_only", "token")
        download = {name: options[name] for name in known if name in options}
        folder = Path(model_id if Path(model_id).is_dir() else snapshot_download(model_id, **download))
        filter = from_pretrained(folder, builders=builders)
        config = read_folder_config(folder, {**_registered.builders(), **(builders or {})})
        builder = (builders or {}).get(config["builder"])  # a filter of the library knows what builds it
        return cls(filter, builder=builder, settings=config["settings"] if builder else None)
