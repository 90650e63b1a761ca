"""GPS and attitude files: what they say, and one sentence for what they do not."""

import numpy as np
import pytest

from sl3d_slam.config import WorldSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.geodesy import GeoReference
from sl3d_slam.geometry.se3 import exp
from sl3d_slam.io.covariances import write_covariances
from sl3d_slam.io.world_files import read_attitude, read_gps, read_world
from sl3d_slam.mapping.georeference import georeference_of, georeference_tree
from sl3d_slam.types import KeyframeCovariances

SETTINGS = WorldSettings(position_sigma_m=2.5, attitude_sigma_deg=0.7)


def written(tmp_path, text):
    path = tmp_path / "fixes.csv"
    path.write_text(text)
    return path


def test_csv_columns_go_by_name(tmp_path):
    text = (
        "alt, t,lat,lon,sigma_u,sigma_e,sigma_n\n115,0,49,8.4,3,1,2\n\n120,0.5,49.001,8.4,6,4,5\n"
    )
    fixes = read_gps(written(tmp_path, text), SETTINGS)
    np.testing.assert_allclose(fixes.stamps_s, [0.0, 0.5])
    np.testing.assert_allclose(fixes.sigmas_m, [[1, 2, 3], [4, 5, 6]])
    assert fixes.origin.latitude_deg == 49.0
    np.testing.assert_allclose(fixes.positions_enu[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(fixes.positions_enu[1], [0.0, 111.2, 5.0], atol=0.1)


def test_tum_is_metric_and_takes_the_settings_sigma(tmp_path):
    fixes = read_gps(written(tmp_path, "1.5 10 20 30 0 0 0 1\n2.5 11 21 31 0 0 0 1\n"), SETTINGS)
    assert fixes.origin is None
    np.testing.assert_allclose(fixes.positions_enu, [[10, 20, 30], [11, 21, 31]])
    np.testing.assert_allclose(fixes.sigmas_m, 2.5)


def test_an_attitude_says_which_way_is_up_in_the_lidar_frame(tmp_path):
    """Rolled by 90 degrees to the right (about +x), the world's up is the lidar's left, +y."""
    half = np.sqrt(0.5)
    by_quaternion = read_attitude(
        written(tmp_path, f"t,qx,qy,qz,qw,sigma_deg\n0,{half},0,0,{half},2\n"), SETTINGS
    )
    np.testing.assert_allclose(by_quaternion.up_lidar, [[0.0, 1.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(by_quaternion.sigmas_rad, np.radians(2.0))
    by_force = read_attitude(written(tmp_path, "t,up_x,up_y,up_z\n0,0,9.81,0\n"), SETTINGS)
    np.testing.assert_allclose(by_force.up_lidar, [[0.0, 1.0, 0.0]])
    np.testing.assert_allclose(by_force.sigmas_rad, np.radians(0.7))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "empty"),
        ("t,lat,lon,alt\n", "rows below"),
        ("0,49,8.4,115\n1,49,8.4,115\n", "no named columns"),
        ("t,lat,lon\n0,49,8\n", "no column 'alt'"),
        ("t,lat,lon,alt\n0,49,8.4\n", "line 2"),
        ("t,lat,lon,alt\n0,49,8.4,nan\n", "line 2"),
        ("t,lat,lon,alt\n0,190,8.4,1\n", "degrees"),
        ("t,lat,lon,alt\n1,49,8.4,1\n0,49,8.4,1\n", "time goes back"),
        ("t,lat,lon,alt,sigma\n0,49,8.4,1,0\n", "sigma"),
        ("1 2 3\n", "8 finite numbers"),
    ],
)
def test_malformed_gps_is_named(tmp_path, text, complaint):
    with pytest.raises(InputError, match=complaint) as error:
        read_gps(written(tmp_path, text), SETTINGS)
    assert "fixes.csv" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("t,x,y,z\n0,0,0,1\n", "no column 'up_x'"),
        ("t,up_x,up_y,up_z\n0,0,0,0\n", "no length"),
        ("t,qx,qy,qz,qw\n0,0,0,0,2\n", "unit length"),
        ("t,up_x,up_y,up_z,sigma_deg\n0,0,0,1,-1\n", "sigma"),
    ],
)
def test_malformed_attitude_is_named(tmp_path, text, complaint):
    with pytest.raises(InputError, match=complaint):
        read_attitude(written(tmp_path, text), SETTINGS)


def test_missing_files_are_named_and_none_is_nothing(tmp_path):
    assert not read_world(None, None, SETTINGS)
    with pytest.raises(InputError, match="not found"):
        read_world(tmp_path / "none.csv", None, SETTINGS)


def test_a_covariance_file_says_order_and_frame(tmp_path, rng):
    matrices = rng.normal(size=(2, 6, 6))
    covariances = KeyframeCovariances([3, 8], matrices, "the first scan")
    write_covariances(tmp_path / "covariance.txt", covariances, np.arange(10) * 0.25)
    text = (tmp_path / "covariance.txt").read_text()
    assert "rotation about x y z (rad), then translation" in text
    assert "relative to the first scan" in text
    table = np.loadtxt(tmp_path / "covariance.txt")
    np.testing.assert_array_equal(table[:, :2], [[0.75, 3], [2.0, 8]])
    np.testing.assert_array_equal(table[:, 2:].reshape(2, 6, 6), matrices)


@pytest.mark.parametrize("tree", [{}, 3, {"T_enu_map": [[1]], "origin": None}])
def test_a_damaged_georeference_is_refused(tree):
    with pytest.raises(ValueError, match="expected georeference"):
        georeference_of(tree)


def test_a_georeference_survives_its_file(tmp_path):
    fixes = read_gps(written(tmp_path, "t,lat,lon,alt\n0,49.1,8.4,115\n1,49.2,8.4,115\n"), SETTINGS)
    before = GeoReference(exp(np.array([0.1, 0.2, 2.0, 3.0, 4.0, 5.0])), fixes.origin)
    after = georeference_of(georeference_tree(before))
    np.testing.assert_array_equal(after.T_enu_map, before.T_enu_map)
    assert after.origin == before.origin
