"""Each demo runs, and its result is the one that its text explains."""

import numpy as np
import pytest
from demo_runner import DEMOS, run_demo


@pytest.fixture
def demo(request, tmp_path):
    """Run the demo after which the test is named; return its variables."""
    name = request.function.__name__.removeprefix("test_")
    return run_demo(name, *getattr(request, "param", ()), folder=tmp_path)


def also_short(*arguments):
    """Run a demo with arguments that make it short, and by `make verify` as a whole."""
    runs = [arguments, pytest.param((), marks=pytest.mark.heavy)]
    return pytest.mark.parametrize("demo", runs, indirect=True, ids=["short", "whole"])


def test_two_beams(demo):
    """Equilibrium of the upper beam: 20 MPa on 3 m^2."""
    assert demo["report"].contacts[0].normal_force == pytest.approx(60e6, rel=1e-6)


def test_hertz_ball(demo):
    """Radius and largest pressure of the contact area by Hertz's formulas."""
    assert demo["errors"]["hexahedra"] == pytest.approx((0.0, 0.0), abs=0.006)
    assert demo["errors"]["tetrahedra"] == pytest.approx((0.0, 0.0), abs=0.025)


def test_hertz_two_balls(demo):
    """Radius and largest pressure of the contact area by Hertz's formulas."""
    assert demo["a_fit"] == pytest.approx(demo["a"], rel=0.015)
    assert demo["p0_fit"] == pytest.approx(demo["p0"], rel=0.006)


def test_hertz_cylinder(demo):
    """Half-width and largest pressure of the contact area by Hertz's formulas."""
    assert demo["errors"]["plane"] == pytest.approx((0.0, 0.0), abs=0.002)
    assert demo["errors"]["groove"] == pytest.approx((0.0, 0.0), abs=0.008)


@pytest.mark.once
def test_roller_crown(demo):
    """The pressure on the strip is its mean, found with few solves."""
    assert demo["last"] < 1e-3 * demo["first"]
    assert demo["worst"] < 0.01
    assert demo["found"].nfev < 40


@pytest.mark.once
def test_hidden_support(demo):
    """Clearance and stiffness are found to the error of the measurements, by few solves."""
    assert demo["last"] < 9.0
    assert demo["clearance"] == pytest.approx(0.7, abs=0.01)
    assert demo["modulus"] == pytest.approx(1.0, rel=0.01)
    assert demo["found"].nfev < 30


@pytest.mark.once
def test_punch_shape(demo):
    """The peak at the punch's edge vanishes, found with few solves."""
    assert demo["peak"][0] > 2.0
    assert demo["peak"][1] < 1.1
    assert demo["last"] < 0.02 * demo["first"]
    assert demo["found"].nfev < 40


def test_axisymmetric_ball(demo):
    """Radius and largest pressure of the contact area by Hertz's formulas; statics."""
    assert demo["F"] == pytest.approx(demo["force"], rel=1e-9)
    assert demo["a_fit"] == pytest.approx(demo["a"], rel=0.005)
    assert demo["p0_fit"] == pytest.approx(demo["p0"], rel=0.01)


def test_rubber_seal(demo):
    """Hooke's law in the full groove, in the meridian's plane and in space."""
    assert demo["p"] == pytest.approx(demo["exact"], rel=0.001)
    assert demo["force_3d"] == pytest.approx(demo["forces"][-1], rel=0.001)


def test_flat_punch(demo):
    """The pressure up to 3/4 of the radius, and the force of the circular punch."""
    assert demo["errors"]["strip"] < 0.006
    assert demo["errors"]["disc"] < 0.035
    assert demo["F"] == pytest.approx(demo["exact"], rel=0.025)


def test_eccentric_punch(demo):
    """The tilt with and without lift-off; a force in the middle does not tilt the punch."""
    assert demo["errors"] == pytest.approx([0.0, 0.0, 0.0], abs=0.035)
    assert abs(demo["errors"][0]) < 1e-8
    assert np.count_nonzero(demo["touching"].active) < 0.6 * np.isfinite(demo["touching"].gap).sum()


@pytest.mark.once
def test_cattaneo_mindlin(demo):
    """What sticks, within an element of the formula."""
    assert len(demo["sticking"]) == 3
    for stick, c, size in demo["sticking"]:
        assert abs(stick - c) <= size


def test_shaft_and_key(demo):
    """Statics of the shaft: all of the moment through the key, whose force the bore balances."""
    key, bore = demo["by_key"], demo["by_bore"]
    assert key[2] == pytest.approx(-demo["moment"], rel=1e-6)
    assert abs(bore[2]) <= 1e-6 * demo["moment"]
    assert key[:2] == pytest.approx(-bore[:2], rel=1e-6, abs=1.0)
    # the arm is that of a place on the flank in the shaft
    assert 6.5e-3 < demo["moment"] / np.hypot(*key[:2]) < 10e-3


@pytest.mark.once
def test_belt_on_drum(demo):
    """The formula of Euler and Eytelwein."""
    for mu, ratio in demo["ratios"].items():
        assert ratio == pytest.approx(np.exp(-mu * np.pi), rel=0.02)


@pytest.mark.once
@also_short("0.33", "0.36")
def test_brick_wall(demo):
    """The upper course slides where the push is more than the coefficient of its weight."""
    assert demo["limit"] == 0.36
    assert [push for push, _ in demo["moved"]][-1] == 0.33
    assert demo["balance"] < 1e-6


def test_stack_of_blocks(demo):
    """Each face carries its column: statics, exactly."""
    assert demo["worst"] < 1e-10
    assert not demo["report"].free_motions


@pytest.mark.parametrize(("demo", "error"), [((), 1e-3), (("3",), 6e-3)], indirect=["demo"])
def test_pile_of_cylinders(demo, error):
    """The contact forces of rigid discs."""
    assert len(demo["errors"]) == 6
    assert max(demo["errors"].values()) < error


def test_roller(demo):
    """The load on each contact; half-width and largest pressure by Hertz's formulas."""
    for force, width, peak in demo["errors"].values():
        assert abs(force) < 1e-10
        assert abs(width) < 0.006
        assert abs(peak) < 0.003
    assert "rotation" in demo["report"].free_motions[0]


@pytest.mark.once
def test_load_steps(demo):
    """The radius by Hertz's formula, the same in unloading as in loading, for as many products."""
    forces, radii = np.array(demo["forces"]), np.array(demo["radii"])
    assert radii.size == 4
    hertz = np.cbrt(3 * forces * demo["R"] / (4 * demo["E_star"]))
    np.testing.assert_allclose(radii, hertz, rtol=0.015)
    np.testing.assert_allclose(radii[3], radii[1], rtol=1e-5)
    assert max(demo["differences"]) < 1e-5  # of a new problem for each step
    # the start from rigid bodies is as good as the contact of half or twice the load
    assert demo["again"] < 1.25 * demo["scratch"]


@pytest.mark.once
@also_short("15")
def test_impact_of_bars(demo):
    """Time, pressure and velocities by the waves of one dimension; energy is kept, or made."""
    c, L = demo["c"], demo["L"]
    assert demo["ends_at"] == pytest.approx(2 * L / c, abs=demo["dt"])
    assert demo["plateau"] == pytest.approx(demo["rho"] * c * demo["v"] / 2, rel=0.001)
    np.testing.assert_allclose(demo["velocities"], [0.0, demo["v"]], atol=0.01)
    np.testing.assert_allclose(demo["energy"], demo["kinetic"], rtol=0.005)
    # nodes with mass rebound from each other
    assert demo["growing"][-1] > 1.5 * demo["kinetic"]
    assert np.count_nonzero(np.diff(demo["jumping"] > 0.0)) > 10


def test_finer_meshes(demo):
    """Half-width and largest pressure by Hertz's formulas; the coarse mesh saves products."""
    contact, element = demo["contact"], demo["size"] / 128
    width = contact.coordinates[contact.active, 0].max()
    assert abs(width - demo["a"]) < element
    assert contact.pressure.max() == pytest.approx(demo["p0"], rel=0.012)
    saved, alone = (demo[key].report for key in ("problem", "alone"))
    assert saved.products["total"] < alone.products["total"]


@pytest.mark.once
def test_adaptive_roller(demo):
    """5 % with a third of the unknowns of uniform meshes, and fewer of degree 2."""
    last = {degree: found.levels[-1] for degree, found in demo["found"].items()}
    assert max(level.error for level in last.values()) <= 0.05
    assert last[1].unknowns < 1800
    assert last[2].unknowns < 600
    uniform = 10.0 ** demo["curves"]["uniform, degree 1"][1][-1]
    assert uniform > 100 * last[1].error


@pytest.mark.once
@pytest.mark.heavy
def test_remeshed_joint(demo):
    """3 % in at most four rounds; the bearing pressure is that of the finer mesh."""
    assert demo["estimate"].error <= 0.03
    assert len(demo["levels"]) <= 5
    assert demo["error"] < demo["estimate"].error
    assert demo["bearing"] == pytest.approx(demo["of_finer"][3], rel=0.02)
    pin = demo["problem"].results["pin in lug"]
    assert abs(pin.force[0]) == pytest.approx(demo["force"] / 4, rel=1e-3)


@pytest.mark.once
@also_short("5", "12")
def test_sliding_block(demo):
    """The force is antisymmetric, its work that of lifting the block, and zero in the end."""
    H, top, largest = demo["H"], demo["top"], np.abs(demo["H"]).max()
    assert abs(H[top]) < 0.01 * largest
    assert demo["parts"][:top].sum() == pytest.approx(demo["rigid_work"], rel=0.01)
    if len(H) > top + 1:
        assert np.abs(H + H[::-1]).max() < 0.035 * largest
        assert abs(demo["parts"].sum()) < 0.02 * demo["rigid_work"]
    np.testing.assert_allclose(demo["F"], demo["pressure"] * demo["width"], rtol=1e-4)


@pytest.mark.once
@also_short("90")
def test_cam(demo):
    """The work of the moment is the energy stored; elastic bodies differ little from rigid ones."""
    assert demo["miss"] < 0.01
    M, rigid = demo["M"], demo["rigid"](demo["angles"])
    assert np.abs(M - rigid).max() < 0.05 * rigid.max()
    moving = rigid > 0.01 * rigid.max()
    assert (M[moving] < rigid[moving]).all()


def test_shrink_fit(demo):
    """The pressure by Lamé's formulas, in the mean and at each node."""
    assert demo["pressure"] == pytest.approx(demo["lame"], rel=0.002)
    assert demo["spread"] < 0.015
    assert demo["problem"].report.contacts[0].matching["discretisation"] == "mortar"


def test_gear_teeth(demo):
    """The force by the statics of the pinion, the contact by Hertz's formulas."""
    assert demo["F"] == pytest.approx(demo["statics"], rel=2e-4)
    assert demo["a_fit"] == pytest.approx(demo["a"], rel=0.01)
    assert demo["p0_fit"] == pytest.approx(demo["p0"], rel=0.01)


def test_tied_block(demo):
    """The displacement by Kirsch's solution."""
    assert demo["errors"]["fine part"] < 0.003
    assert demo["errors"]["coarse part"] < 0.0006
    assert [
        entry["discretisation"] for entry in [c.matching for c in demo["problem"].report.contacts]
    ] == ["tied"] * 2


def test_ball_in_socket(demo):
    """Small loads by Hertz's formulas, the largest by a finer mesh, forces by statics."""
    a, p0 = demo["hertz"][0]
    assert demo["radii"][0] == pytest.approx(a, rel=0.01)
    assert demo["peaks"][0] == pytest.approx(p0, rel=0.02)
    assert (demo["radii"][-1], demo["peaks"][-1]) == pytest.approx(demo["finer"], rel=0.005)
    assert demo["F"] == pytest.approx(demo["forces"][-1], rel=1e-8)


def test_bolt_in_lug(demo):
    """The force by statics, extent of the contact and displacement by a finer mesh."""
    assert demo["forces"] == pytest.approx([24e3] * 3, rel=1e-8)
    for angle, end in demo["errors"]:
        assert abs(angle) < 0.02
        assert abs(end) < 0.012


def test_plank(demo):
    """Force and length by beam theory, the weight by statics."""
    assert demo["lifting_force"] == pytest.approx(demo["V"], rel=0.002)
    assert demo["first_contact"] == pytest.approx(demo["s"], rel=0.03)
    carried = demo["lifting_force"] + demo["floor_force"]
    assert carried == pytest.approx(demo["q"] * demo["length"], rel=1e-8)
    np.testing.assert_allclose(demo["deflection"], demo["beam"], atol=0.005 * demo["delta"])
    # all squares share one factor
    assert demo["report"].classes == 1


def test_scikit_fem_rollers(demo):
    """Half-width and largest pressure by Hertz's formulas, the force by statics."""
    assert 2 * demo["report"].contacts[0].normal_force == pytest.approx(demo["force"], rel=1e-8)
    assert demo["a_fit"] == pytest.approx(demo["a"], rel=0.005)
    assert demo["p_fit"] == pytest.approx(demo["p_0"], rel=0.005)


@pytest.mark.once
def test_roller_bearing(demo):
    """Balance; the largest loads of the model of rigid rings; none outside its loaded zone."""
    assert demo["balance"] < 1e-6 * demo["radial"]
    assert demo["report"].converged
    loads = np.array([demo["loads"][f"outer raceway {row}"] for row in (1, 2)])
    rigid = demo["rigid"]
    np.testing.assert_allclose(loads.max(axis=1), rigid.max(axis=1), rtol=0.1)
    assert (rigid == 0.0).any()
    assert (loads[rigid == 0.0] < 1e-3 * loads.max()).all()
    # each roller spins and slides freely
    motions = demo["report"].free_motions
    assert sum("translation" in motion for motion in motions) >= 16
    assert sum(motion.count("rotation") == 1 for motion in motions) >= 16


def test_bearing_sector(demo):
    """Statics; a pressure above that of rollers without crown."""
    assert demo["problem"].report.converged
    assert demo["Q"] == pytest.approx(demo["statics"], rel=1e-3)
    assert 1.1 * demo["p_hertz"] < demo["p_middle"] < 1.3 * demo["p_hertz"]


@pytest.mark.once
@also_short("15")
def test_flange(demo):
    """The last bolt has the force of the wrench; the gasket leaves the others more than that."""
    force, history = demo["preload"], demo["history"]
    for k, row in enumerate(history):
        assert row[k] == pytest.approx(force, rel=1e-6)
    assert history[2][0] > history[1][0] > 1.05 * force
    assert 0.2 < demo["factor"] < 0.4


def test_each_demo_has_a_test():
    names = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    demos = {path.stem for path in DEMOS.glob("*.py")}
    assert demos and demos <= names


def test_demos_say_how_they_are_run():
    for path in DEMOS.glob("*.py"):
        assert f"python demos/{path.name}" in path.read_text()


@pytest.mark.once
@also_short("1e-6")
def test_fibre_block(demo):
    """Cords cost no more than half as many products again; the same energy without deflation."""
    counts = {name: products[-1] for name, products in demo["products"].items()}
    deflated, rubber = counts["steel cords, deflation"], counts["rubber alone"]
    assert deflated <= 1.5 * rubber
    assert counts["steel cords, no deflation"] > 5 * deflated
    energies = demo["energies"]
    plain = energies["steel cords, no deflation"]
    assert energies["steel cords, deflation"] == pytest.approx(plain, rel=1e-9)
    assert demo["report"].contacts[0].normal_force == pytest.approx(30e3, rel=1e-6)


@pytest.mark.once
@also_short("3")
def test_ironing(demo):
    """Friction at its bound and the bulge before the die; the balance of energy."""
    ratio = demo["H"][2:] / demo["N"][2:]
    assert ((ratio > 0.3) & (ratio < 0.31)).all()
    if len(ratio) > 1:
        # the trapezoidal rule needs more than the step in which the die begins to slide
        assert demo["work"] == pytest.approx(demo["friction"] + demo["gained"], rel=0.04)


@pytest.mark.once
@also_short("0.2")
def test_seal_in_groove(demo):
    """The energy is the work of the lid; both walls are pressed alike."""
    assert demo["energies"][-1] == pytest.approx(demo["work"], rel=0.02)
    left, right = (demo["problem"].results[f"{side} wall"].force for side in ("left", "right"))
    assert (left[0] > 0.0) == (demo["squeeze"] > 0.9e-3)
    np.testing.assert_allclose(right, [-left[0], left[1]], rtol=1e-4)


@pytest.mark.once
@also_short("0.2")
def test_crushed_ring(demo):
    """The forces of the elastica, at each height."""
    assert demo["heights"][-1] == pytest.approx(2 * demo["R"] - demo["closing"])
    assert demo["error"] < 0.01


@pytest.mark.once
@also_short("2")
def test_folded_strip(demo):
    """Both folds close, nothing comes in, and the plate has the same forces on its way back."""
    assert demo["pressing"] >= 20 and demo["depth"] < 1e-6 * demo["gap"]
    assert demo["returned"] < 1e-5 and demo["loading"].max() < demo["forces"][demo["way"][-1]][0]


@pytest.mark.once
@also_short("0.1")
def test_pinched_tube(demo):
    """The walls meet when the bars are 2 t apart, and have nearly all of the bars' force."""
    way, force, walls = (np.array(demo[name]) for name in ("way", "force", "walls"))
    is_open = way <= 1 - demo["t"] / (2 * demo["R"]) - 0.01
    assert not walls[is_open].any() and (np.diff(force) > 0.0).all()
    if way[-1] > 0.95:
        assert 0.95 < walls[-1] / force[-1] < 1.0 and force[-1] > 30 * force[is_open].max()
        assert demo["depth"] < 1e-6 * demo["t"]


@pytest.mark.once
@also_short("0.1")
def test_coil_spring(demo):
    """The wire is twisted as a square bar is, until coils press on each other."""
    way, force = np.array(demo["travel"]), np.array(demo["force"])
    expected, is_open = demo["rate"] * way, way < 0.85 * demo["free"]
    np.testing.assert_allclose(force[is_open], expected[is_open], rtol=0.06)
    if way[-1] > demo["free"]:
        assert demo["pressing"] >= 20 and force[-1] > 3 * expected[-1]
        assert demo["problem"].report.contacts[0].penetration < 0.01 * demo["edge"]


@pytest.mark.once
@also_short("0.3")
def test_snap_fit(demo):
    """The balance of energy; the force changes its sign behind the bump, and ends with zero."""
    H, way = demo["H"], np.array(demo["way"])
    top = demo["start"]
    assert H[way < top].min() >= -1e-6 * H.max() and (H[way > 1.3 * top] <= 1e-6 * H.max()).all()
    kept = demo["friction"] + demo["left"]
    if way[-1] < top:
        # the force grows, and friction is that of the ends of the steps
        assert demo["work"] < kept < np.sum(H[1:] * np.diff(way))
        assert 0.0 < demo["friction"] < demo["left"]
    else:
        assert H[-1] == pytest.approx(0.0, abs=1e-6 * H.max())
        assert demo["left"] < 1e-6 * demo["work"]
        assert demo["work"] == pytest.approx(kept, rel=0.05)


@pytest.mark.once
@also_short("9")
def test_beam_on_beam(demo):
    """Beam theory for small deflections; the energy is the work of the clamp."""
    assert demo["force"][1] == pytest.approx(demo["linear"][1], rel=0.005)
    assert demo["energies"][-1] == pytest.approx(demo["work"], rel=0.002)


@pytest.mark.once
@also_short("4")
def test_delaminating_beam(demo):
    """Beam theory: the load at small openings, the peak, and the growth of the crack."""
    curve, load, opened = demo["curve"], demo["load"], demo["opened"]
    first = np.flatnonzero(curve[:, 0] == demo["openings"][0])[0]
    slope = curve[first, 1] / curve[first, 0] / (load[0] / opened[0])
    assert slope == pytest.approx(1.0, abs=0.01)
    if len(demo["openings"]) > 4:
        assert demo["peak"][1] == pytest.approx(load[0], rel=0.015)
        assert curve[-1, 1] == pytest.approx(np.interp(curve[-1, 0], opened, load), rel=0.01)
        # on the way back the line to the origin
        back = np.flatnonzero(curve[:, 0] == 3.25)[0]
        assert curve[back, 1] / 3.25 == pytest.approx(curve[back - 1, 1] / 6.5, rel=1e-6)


@pytest.mark.once
@also_short("2")
def test_peeled_strip(demo):
    """What the glue has taken is the work that is not stored, by chords; the force falls."""
    assert demo["spent"] == pytest.approx(demo["work"] - demo["stored"], rel=0.05, abs=0.05)
    if len(demo["heights"]) > 2:
        assert demo["F"][-1] < 0.8 * demo["F"].max()
