#!/usr/bin/env python3
"""Simulate a one-cylinder machine file with Exudyn: an independent check of hydroflex.

Everything is done by other people's code: the mesh is assembled by scikit-fem (quadratic and linear
tetrahedra), reduced by Exudyn's Hurty/Craig-Bampton modes, and integrated by Exudyn. The machine file
and the mesh are the only things shared with hydroflex.

    pip install exudyn==1.13.6 scikit-fem numpy scipy pyarrow
    python sim/validation/exudyn_lift_boom.py --machine sim/machines/lift-boom.toml \
        --mesh sim/machines/lift-boom/lift-boom.inp --runs RUNS.parquet --out trajectories.parquet \
        --scheme generalized-alpha --step-s 1e-4

Exudyn's conventions differ in two switches of the machine file (`gravity_moment = "undeformed"`,
`marker_rotation = "additive"`): compare with a copy of the file that sets them, and that
weights interfaces uniformly (`weights = "uniform"`). Strain and stress are left
out: Exudyn recovers them at corner nodes of linear meshes only. End stops and the vapour floor are not
modelled here: choose runs that stay clear of both.
"""
import argparse
import math
import tomllib

import exudyn as exu
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.sparse as sp
from exudyn.FEM import FEMinterface, HCBstaticModeSelection, ObjectFFRFreducedOrderInterface
from exudyn.itemInterface import (
    DistanceConstraint, Force, GenericJoint, HydraulicActuatorSimple, MarkerBodyPosition, MarkerBodyRigid,
    MarkerNodePosition, MarkerNodeRigid, MarkerSuperElementPosition, MassPoint, NodeGenericODE1, NodePoint,
    ObjectGround, SensorNode, SensorObject, SensorSuperElement, SphericalJoint, SpringDamper)
from exudyn.rigidBodyUtilities import RotationMatrixZ


def read_inp(path):
    """Nodes and tetrahedra of an Abaqus file with one part."""
    nodes, elements, width, kind = [], [], 0, None
    pending = []
    for line in open(path):
        if line.startswith("*"):
            key = line.upper().replace(" ", "")
            if key.startswith("*NODE") and not key.startswith("*NODEOUTPUT"):
                kind = "node"
            elif key.startswith("*ELEMENT,") and "C3D4" in key:
                kind, width = "element", 4
            elif key.startswith("*ELEMENT,") and "C3D10" in key:
                kind, width = "element", 10
            else:
                kind = None
            continue
        numbers = [f for f in line.replace("\n", "").split(",") if f.strip()]
        if kind == "node":
            nodes.append((int(numbers[0]), *map(float, numbers[1:4])))
        elif kind == "element":
            pending += map(int, numbers)
            while len(pending) >= width + 1:
                elements.append(pending[1:width + 1])
                pending = pending[width + 1:]
    index = {n[0]: i for i, n in enumerate(nodes)}
    return np.array([n[1:] for n in nodes]), np.array([[index[n] for n in e] for e in elements])


def assemble(x, tets, material):
    """Consistent stiffness and mass by scikit-fem, in our node order (3 dofs per node)."""
    import skfem
    from skfem.models.elasticity import lame_parameters, linear_elasticity
    young, poisson, density = (material[k] for k in ("youngs_modulus_pa", "poisson_ratio", "density_kg_per_m3"))
    corners = np.unique(tets[:, :4])
    renumber = -np.ones(len(x), int)
    renumber[corners] = np.arange(len(corners))
    mesh = skfem.MeshTet(x[corners].T.copy(), renumber[tets[:, :4]].T.copy())
    midside = {}  # pair of corners -> our node between them
    if tets.shape[1] == 10:
        for k, (a, b) in enumerate([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]):
            pairs = np.sort(renumber[tets[:, [a, b]]], axis=1)
            midside.update(zip(map(tuple, pairs.tolist()), tets[:, 4 + k].tolist()))
        # Isoparametric: the edges of a bore are curved.
        mesh = skfem.MeshTet2.from_mesh(mesh)
        for edge, node in zip(mesh.edges.T.tolist(), mesh.dofs.edge_dofs[0]):
            mesh.doflocs[:, node] = x[midside[tuple(sorted(edge))]]
    element = skfem.ElementVector(skfem.ElementTetP2() if midside else skfem.ElementTetP1())
    basis = skfem.Basis(mesh, element, intorder=5 if midside else 2)
    stiffness = linear_elasticity(*lame_parameters(young, poisson)).assemble(basis)
    mass = density * skfem.BilinearForm(lambda u, v, w: skfem.helpers.dot(u, v)).assemble(basis)
    order_map = np.empty(3 * len(x), int)
    for c in range(3):
        order_map[3 * corners + c] = basis.nodal_dofs[c]
        if midside:
            nodes = np.array([midside[tuple(sorted(edge))] for edge in mesh.edges.T.tolist()])
            order_map[3 * nodes + c] = basis.edge_dofs[c]
    assert len(np.unique(order_map)) == basis.N, "mesh nodes and finite-element nodes differ"
    return stiffness.tocsr()[order_map][:, order_map], mass.tocsr()[order_map][:, order_map]


def lump(x, tets, density):
    """A quarter of each linear tetrahedron's mass on each node."""
    a, b, c, d = (x[tets[:, i]] for i in range(4))
    volume = np.abs(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)) / 6
    diagonal = np.zeros(len(x))
    for i in range(4):
        np.add.at(diagonal, tets[:, i], density * volume / 4)
    return sp.diags(np.repeat(diagonal, 3)).tocsr()


def select(x, interface):
    c = interface["select"]["cylinder"]
    start, end = np.array(c["axis_start_m"]), np.array(c["axis_end_m"])
    length = np.linalg.norm(end - start)
    axis = (end - start) / length
    along = (x - start) @ axis
    radial = np.linalg.norm(x - start - np.outer(along, axis), axis=1)
    t, r = c["tolerance_m"], c["radius_m"]
    return np.flatnonzero((along >= -t) & (along <= length + t) & (np.abs(radial - r) <= t))


def area_weights(x, tets, nodes):
    """Weights by surface triangles whose three nodes belong to the set (linear tetrahedra)."""
    faces = np.sort(np.concatenate([tets[:, f] for f in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3])]), axis=1)
    unique, counts = np.unique(faces, axis=0, return_counts=True)
    inside = set(nodes.tolist())
    weights = dict.fromkeys(nodes.tolist(), 0.0)
    for f in unique[counts == 1]:
        if all(n in inside for n in f):
            area = np.linalg.norm(np.cross(x[f[1]] - x[f[0]], x[f[2]] - x[f[0]])) / 2
            for n in f:
                weights[n] += area / 3
    w = np.array([weights[n] for n in nodes.tolist()])
    return w / w.sum()


class Boom:
    """A machine with one flexible body, reduced by Exudyn for runs with or without payload."""

    def __init__(self, machine, mesh):
        self.machine = machine
        self.body = machine["body"][0]
        self.x, self.tets = read_inp(mesh)
        self.stiffness, consistent = assemble(self.x, self.tets, self.body["material"])
        lumped = self.body.get("mass_matrix", "consistent") == "lumped"
        self.mass = lump(self.x, self.tets, self.body["material"]["density_kg_per_m3"]) if lumped else consistent
        self.sets = {i["name"]: select(self.x, i) for i in self.body["interface"]}
        self.reduced = {}
        tip = next(s for s in machine["sensor"] if s["quantity"] == "deflection")
        self.tip = int(np.argmin(((self.x - np.array(tip["near_m"])) ** 2).sum(1)))
        # The joint holds the mean of its interface's nodes: put the frame there, so that it holds the frame.
        first = self.body["interface"][0]
        nodes = self.sets[first["name"]]
        self.x = self.x - self.weights(first, nodes) @ self.x[nodes]

    def weights(self, interface, nodes):
        """Marker weights; by area for linear tetrahedra only."""
        if interface.get("weights") == "area":
            assert self.tets.shape[1] == 4, "area weights are for linear meshes here: use uniform ones for both"
            return area_weights(self.x, self.tets, nodes)
        return np.full(len(nodes), 1 / len(nodes))

    def fem(self, payload):
        """Exudyn's finite-element data with Hurty/Craig-Bampton modes."""
        fem = FEMinterface()
        fem.nodes = {"Position": self.x}
        fem.massMatrix, fem.stiffnessMatrix = self.mass.tocsr(), self.stiffness.tocsr()
        allowed = ("always", "with_payload") if payload else ("always",)
        boundary = [self.sets[i["name"]] for i in self.body["interface"] if i.get("boundary", "always") in allowed]
        fem.ComputeHurtyCraigBamptonModes([b.tolist() for b in boundary], self.body["normal_modes"],
                                          useSparseSolver=True, computationMode=HCBstaticModeSelection.RBE2)
        return fem

    def interface(self, payload):
        """Exudyn's reduced body on substitute nodes: one per interface (weighted mean) and the tip."""
        if payload in self.reduced:
            return self.reduced[payload]
        fem = self.fem(payload)
        cms = ObjectFFRFreducedOrderInterface(fem)
        basis, position, names = [], [], []
        for i in self.body["interface"]:
            nodes = self.sets[i["name"]]
            w = self.weights(i, nodes)
            basis.append(sum(wk * cms.modeBasis[3 * n:3 * n + 3] for wk, n in zip(w, nodes)))
            position.append(w @ self.x[nodes])
            names.append(i["name"])
        basis.append(cms.modeBasis[3 * self.tip:3 * self.tip + 3])
        position.append(self.x[self.tip])
        names.append("tip")
        cms.modeBasis, cms.xRef = np.vstack(basis), np.concatenate(position)
        cms.trigList, cms.nNodes = [], len(names)
        self.reduced[payload] = (cms, names)
        return self.reduced[payload]


    def attachment(self, name, names):
        """Mesh nodes of the reduced body, and their weights, that stand for an interface or the tip."""
        return [names.index(name)], [1.0]


def friction_force(spec):
    kind = spec["kind"]
    if kind == "brown_mcphee":
        fc, fs, s2, vt = (spec[k] for k in ("coulomb_n", "static_n", "viscous_n_s_per_m", "transition_velocity_m_per_s"))
        return lambda v: (fc * math.tanh(4 * v / vt) + (fs - fc) * (v / vt) / (0.25 * (v / vt) ** 2 + 0.75) ** 2
                          + s2 * v * math.tanh(4))
    if kind == "stribeck":
        d, s, ve, vr = (spec[k] for k in ("dynamic_n", "static_offset_n", "decay_velocity_m_per_s", "regularisation_velocity_m_per_s"))
        return lambda v: ((d + s) * v / vr if abs(v) <= vr
                          else math.copysign(d + s * math.exp(-(abs(v) - vr) / ve), v))
    return lambda v: 0.0


def simulate(boom, run, scheme, step_s, sample_s, python_spring=True, measure=None):
    """One run. Without `python_spring`, friction is left out and the spring beside the cylinder is Exudyn's own;
    `measure` is called with the integration as its argument."""
    machine, payload = boom.machine, run["payload_kg"]
    cylinder, joint = machine["cylinder"][0], machine["joint"][0]
    name, angle_name = cylinder["name"], machine["angle"][0]["name"]
    cms, names = boom.interface(payload > 0)
    theta = run[f"angle_{angle_name}_rad"]
    gravity = np.array(machine["gravity_m_per_s2"])
    pivot = np.array(joint["from"]["point_m"])
    base = np.array(cylinder["base"]["point_m"])

    container = exu.SystemContainer()
    mbs = container.AddSystem()
    ground = mbs.AddObject(ObjectGround())
    damping = boom.body["damping"]
    assert damping["kind"] == "rayleigh", "Exudyn's reduced body takes Rayleigh damping"
    flexible = cms.AddObjectFFRFreducedOrder(
        mbs, positionRef=pivot.tolist(), rotationMatrixRef=RotationMatrixZ(theta), gravity=gravity.tolist(),
        massProportionalDamping=damping["mass_factor_per_s"],
        stiffnessProportionalDamping=damping["stiffness_factor_s"])
    body = flexible["oFFRFreducedOrder"]

    def marker(n):
        nodes, weights = boom.attachment(n, names)
        return mbs.AddMarker(MarkerSuperElementPosition(
            bodyNumber=body, meshNodeNumbers=nodes, weightingFactors=weights))

    def position(n):
        nodes, weights = boom.attachment(n, names)
        return sum(w * np.asarray(cms.xRef)[3 * k:3 * k + 3] for k, w in zip(nodes, weights))

    frame = mbs.AddMarker(MarkerNodeRigid(nodeNumber=flexible["nRigidBody"]))
    bearing = mbs.AddMarker(MarkerBodyRigid(bodyNumber=ground, localPosition=pivot.tolist()))
    mbs.AddObject(GenericJoint(markerNumbers=[bearing, frame], constrainedAxes=[1, 1, 1, 1, 1, 0]))

    eye = mbs.AddMarker(MarkerBodyPosition(bodyNumber=ground, localPosition=base.tolist()))
    rod = marker(cylinder["rod"]["interface"])
    if payload > 0:
        at = machine["payload"]["at"]["interface"]
        place = pivot + RotationMatrixZ(theta) @ position(at)
        node = mbs.AddNode(NodePoint(referenceCoordinates=place.tolist()))
        mass = mbs.AddObject(MassPoint(mass=payload, nodeNumber=node))
        point = mbs.AddMarker(MarkerNodePosition(nodeNumber=node))
        mbs.AddLoad(Force(markerNumber=point, loadVector=(payload * gravity).tolist()))
        mbs.AddObject(SphericalJoint(markerNumbers=[marker(at), point]))

    area = math.pi / 4 * cylinder["piston_diameter_m"] ** 2
    area_rod = area - math.pi / 4 * cylinder["rod_diameter_m"] ** 2
    hose = math.pi / 4 * cylinder["hose"]["diameter_m"] ** 2 * cylinder["hose"]["length_m"]
    fluid, valve = cylinder["fluid"], cylinder["valve"]
    start = cylinder["initial_pressure_pa"]
    pressures = mbs.AddNode(NodeGenericODE1(referenceCoordinates=[0, 0], initialCoordinates=[start, start],
                                            numberOfODE1Coordinates=2))
    actuator = mbs.AddObject(HydraulicActuatorSimple(
        markerNumbers=[eye, rod], nodeNumbers=[pressures], offsetLength=cylinder["closed_length_m"],
        strokeLength=cylinder["stroke_m"], chamberCrossSection0=area, chamberCrossSection1=area_rod,
        hoseVolume0=hose, hoseVolume1=hose, valveOpening0=0, valveOpening1=0,
        actuatorDamping=cylinder["damping_n_s_per_m"], oilBulkModulus=fluid["bulk_modulus_oil_pa"],
        cylinderBulkModulus=fluid["bulk_modulus_cylinder_pa"], hoseBulkModulus=fluid["bulk_modulus_hose_pa"],
        nominalFlow=valve["flow_coefficient_m3_per_s_per_sqrt_pa"], systemPressure=valve["supply_pressure_pa"],
        tankPressure=valve["tank_pressure_pa"], useChamberVolumeChange=True))
    friction, spring = friction_force(cylinder["friction"]), cylinder.get("parallel_spring")

    def parallel(mbs, t, item, u, v, stiffness, damp, force):
        extra = 0.0
        if spring:
            extra = spring["stiffness_n_per_m"] * u + spring["damping_n_s_per_m"] * v + spring["cubic_stiffness_n_per_m3"] * u ** 3
        return friction(v) + extra

    free = spring["free_length_m"] if spring else 0.001
    if python_spring:
        mbs.AddObject(SpringDamper(markerNumbers=[eye, rod], referenceLength=free, springForceUserFunction=parallel))
    elif spring:
        mbs.AddObject(SpringDamper(markerNumbers=[eye, rod], referenceLength=free,
                                   stiffness=spring["stiffness_n_per_m"], damping=spring["damping_n_s_per_m"]))
    tip = position(cylinder["rod"]["interface"])
    length0 = float(np.linalg.norm(pivot + RotationMatrixZ(theta) @ tip - base))
    lock = mbs.AddObject(DistanceConstraint(markerNumbers=[eye, rod], distance=length0))

    store = dict(storeInternal=True, writeToFile=False)
    out = exu.OutputVariableType
    sensors = {
        "tip": mbs.AddSensor(SensorSuperElement(bodyNumber=body, meshNodeNumber=boom.attachment("tip", names)[0][0],
                                                outputVariableType=out.DisplacementLocal, **store)),
    }
    sensors["coordinates"] = mbs.AddSensor(SensorNode(nodeNumber=flexible["nRigidBody"], outputVariableType=out.RotationMatrix, **store))
    sensors["omega"] = mbs.AddSensor(SensorNode(nodeNumber=flexible["nRigidBody"], outputVariableType=out.AngularVelocity, **store))
    sensors["alpha"] = mbs.AddSensor(SensorNode(nodeNumber=flexible["nRigidBody"], outputVariableType=out.AngularAcceleration, **store))
    sensors["pressure"] = mbs.AddSensor(SensorNode(nodeNumber=pressures, outputVariableType=out.Coordinates, **store))
    sensors["length"] = mbs.AddSensor(SensorObject(objectNumber=actuator, outputVariableType=out.Distance, **store))
    sensors["velocity"] = mbs.AddSensor(SensorObject(objectNumber=actuator, outputVariableType=out.VelocityLocal, **store))
    mbs.Assemble()

    # Equilibrium with the length held, then the piston pressure that holds it (theory: section 9).
    settings = exu.SimulationSettings()
    settings.staticSolver.newton.relativeTolerance = 1e-10
    settings.staticSolver.newton.absoluteTolerance = 1e-8
    settings.staticSolver.numberOfLoadSteps = 10
    settings.staticSolver.verboseMode = 0
    settings.solution.file.write = False
    mbs.SolveStatic(settings, updateInitialValues=True)
    multiplier = mbs.GetObjectOutput(lock, exu.OutputVariableType.Force)
    force = float(np.atleast_1d(multiplier)[0])
    mbs.SetObjectParameter(lock, "activeConnector", False)
    p = mbs.systemData.GetODE1Coordinates()
    p[0] += force / area
    mbs.systemData.SetODE1Coordinates(p, exu.ConfigurationType.Initial)

    signal = np.concatenate([[0.0], run[f"valve_{name}_ratio"]])
    times = np.arange(len(signal)) * sample_s
    limits = cylinder.get("stroke_cutoff")

    def before_step(mbs, t):
        u = float(np.interp(t, times, signal))
        if limits:
            length = float(mbs.GetObjectOutput(actuator, exu.OutputVariableType.Distance))
            if not limits["min_length_m"] <= length <= limits["max_length_m"]:
                u = 0.0
        mbs.SetObjectParameter(actuator, "valveOpening0", u)
        mbs.SetObjectParameter(actuator, "valveOpening1", -u)
        return True

    mbs.SetPreStepUserFunction(before_step)
    steps_per_sample = round(sample_s / step_s)
    settings = exu.SimulationSettings()
    time = settings.timeIntegration
    time.endTime = (len(signal) - 1) * sample_s
    time.numberOfSteps = (len(signal) - 1) * steps_per_sample
    time.verboseMode = 0
    time.newton.useModifiedNewton = True
    time.newton.relativeTolerance, time.newton.absoluteTolerance = 1e-8, 1e-10
    time.generalizedAlpha.computeInitialAccelerations = True
    time.generalizedAlpha.spectralRadius = 0.7
    settings.solution.file.write = False
    settings.solution.sensors.writePeriod = sample_s
    kind = (exu.DynamicSolverType.TrapezoidalIndex2 if scheme == "trapezoidal-index-2"
            else exu.DynamicSolverType.GeneralizedAlpha)
    integrate = lambda: mbs.SolveDynamic(settings, solverType=kind)
    measure(integrate) if measure else integrate()
    read = lambda s: mbs.GetSensorStoredData(sensors[s])
    rotation, tip, pressure = read("coordinates"), read("tip"), read("pressure")
    # Exudyn reports the rate of the length as a scalar, or as a vector along the cylinder.
    velocity = read("velocity")[:, 1]
    n = len(signal)
    assert all(len(read(s)) == n for s in sensors), "samples are missing"
    return {
        "run_id": np.full(n, run["run_id"], np.uint64), "step": np.arange(n, dtype=np.int32), "time_s": times,
        f"valve_{name}_ratio": signal, f"length_{name}_m": read("length")[:, 1],
        f"velocity_{name}_m_per_s": velocity,
        f"pressure_{name}_piston_pa": pressure[:, 1], f"pressure_{name}_rod_pa": pressure[:, 2],
        f"angle_{angle_name}_rad": np.arctan2(rotation[:, 4], rotation[:, 1]),
        f"angular_velocity_{angle_name}_rad_per_s": read("omega")[:, 3],
        f"angular_acceleration_{angle_name}_rad_per_s2": read("alpha")[:, 3],
        "deflection_tip_x_m": tip[:, 1], "deflection_tip_y_m": tip[:, 2], "deflection_tip_z_m": tip[:, 3],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machine", required=True)
    parser.add_argument("--mesh", required=True)
    parser.add_argument("--runs", required=True)
    parser.add_argument("--out", required=True)
    parser.add_argument("--scheme", choices=["trapezoidal-index-2", "generalized-alpha"], default="generalized-alpha")
    parser.add_argument("--step-s", type=float, default=1e-4)
    parser.add_argument("--sample-s", type=float, default=0.005)
    a = parser.parse_args()
    boom = Boom(tomllib.load(open(a.machine, "rb")), a.mesh)
    print(f"mass {boom.mass.diagonal().sum() / 3 if boom.body.get('mass_matrix') == 'lumped' else boom.mass.sum() / 3:.6f} kg, "
          f"{len(boom.x)} nodes, {len(boom.tets)} elements")
    tables = []
    for run in pq.read_table(a.runs).to_pylist():
        tables.append(pa.table(simulate(boom, run, a.scheme, a.step_s, a.sample_s)))
        print(f"run {run['run_id']}: {tables[-1].num_rows} samples", flush=True)
    pq.write_table(pa.concat_tables(tables), a.out, compression="zstd")


if __name__ == "__main__":
    main()
