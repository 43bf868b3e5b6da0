"""Contract of a pad layout."""

import numpy as np

from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.plugins import PAD_LAYOUTS
from tactile.layout import TaxelLayout


def test_it_has_its_name_and_is_the_same_each_time(plugin_name: str) -> None:
    layout: TaxelLayout = PAD_LAYOUTS[plugin_name]()
    assert layout.name == plugin_name
    assert layout == PAD_LAYOUTS[plugin_name]()


def test_gripping_pads_face_each_other(plugin_name: str) -> None:
    layout: TaxelLayout = PAD_LAYOUTS[plugin_name]()
    first, second = (layout.taxels_of(pad) for pad in layout.gripping_pads)
    assert np.allclose(layout.position_m[first], layout.position_m[second])


def test_a_config_names_it(plugin_name: str) -> None:
    tactile = changed_config(CellConfig().tactile, {"layout": plugin_name})
    assert layout_from_config(tactile).name == plugin_name
