#!/usr/bin/env python3
"""Simulate a machine of several bodies, joints and cylinders with Exudyn: an independent check of hydroflex,
and the clock that its speed is compared with.

As exudyn_lift_boom.py: meshes are assembled by scikit-fem, reduced by Exudyn, integrated by Exudyn; the machine
file and the meshes are all that is shared. Interfaces become four substitute nodes that move with the interface's
averaged displacement and rotation, so that Exudyn's markers see exactly what the full node sets would show; that
is also Exudyn's fastest way to run such a model.

    pip install exudyn==1.13.6 scikit-fem numpy scipy pyarrow
    python sim/validation/exudyn_crane.py --machine sim/machines/crane-published.toml \
        --mesh lift=LiftBoom-Job-1.inp --mesh tilt=TiltBoom-Job-1.inp --runs RUNS.parquet --out trajectories.parquet \
        --scheme generalized-alpha --step-s 1e-4 [--no-friction]

`--no-friction` leaves the Stribeck term (2.5 N at most on the crane) out, which is a Python function in Exudyn.
The user CPU time of every run's integration is printed. Strain and stress are left out.
"""
import argparse
import math
import os
import sys
import tomllib

import exudyn as exu
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from exudyn.FEM import FEMinterface, HCBstaticModeSelection, ObjectFFRFreducedOrderInterface
from exudyn.itemInterface import (
    DistanceConstraint, Force, GenericJoint, HydraulicActuatorSimple, MarkerBodyPosition, MarkerBodyRigid,
    MarkerNodePosition, MarkerSuperElementPosition, MarkerSuperElementRigid, MassPoint, NodeGenericODE1, NodePoint,
    ObjectGround, SensorNode, SensorObject, SensorSuperElement, SphericalJoint, SpringDamper)
from exudyn.rigidBodyUtilities import AddRigidBody, RigidBodyInertia, RotationMatrixZ, Skew
from scipy.optimize import least_squares

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from exudyn_lift_boom import area_weights, assemble, friction_force, lump, read_inp, select

TETRAHEDRON = 0.05 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
FREE = {"revolute": [1, 1, 1, 1, 1, 0], "fixed": [1, 1, 1, 1, 1, 1], "planar_pin": [1, 1, 0, 0, 0, 0]}


class Flexible:
    """A flexible body on substitute nodes, reduced by Exudyn."""

    def __init__(self, spec, mesh, sensors):
        self.spec = spec
        self.x, tets = read_inp(mesh)
        stiffness, mass = assemble(self.x, tets, spec["material"])
        if spec.get("mass_matrix", "consistent") == "lumped":
            mass = lump(self.x, tets, spec["material"]["density_kg_per_m3"])
        sets = {i["name"]: select(self.x, i) for i in spec["interface"]}
        weights = {i["name"]: area_weights(self.x, tets, sets[i["name"]]) if i.get("weights") == "area"
                   else np.full(len(sets[i["name"]]), 1 / len(sets[i["name"]])) for i in spec["interface"]}
        fem = FEMinterface()
        fem.nodes = {"Position": self.x}
        fem.massMatrix, fem.stiffnessMatrix = mass.tocsr(), stiffness.tocsr()
        boundary = [sets[i["name"]].tolist() for i in spec["interface"] if i.get("boundary", "always") == "always"]
        fem.ComputeHurtyCraigBamptonModes(boundary, spec["normal_modes"], useSparseSolver=True,
                                          computationMode=HCBstaticModeSelection.RBE2)
        self.cms = ObjectFFRFreducedOrderInterface(fem)
        full = self.cms.modeBasis
        basis, position = [], []
        self.nodes, self.point = {}, {}
        for name, nodes in sets.items():
            w = weights[name]
            mean = w @ self.x[nodes]
            psi = sum(wk * full[3 * n:3 * n + 3] for wk, n in zip(w, nodes))
            inertia = -sum(wk * Skew(self.x[n] - mean) @ Skew(self.x[n] - mean) for wk, n in zip(w, nodes))
            turn = np.linalg.solve(inertia, sum(wk * Skew(self.x[n] - mean) @ full[3 * n:3 * n + 3]
                                                for wk, n in zip(w, nodes)))
            self.nodes[name] = list(range(len(position), len(position) + 4))
            self.point[name] = mean
            for offset in TETRAHEDRON:
                position.append(mean + offset)
                basis.append(psi - Skew(offset) @ turn)
        self.tip = None
        for s in sensors:
            if s["quantity"] == "deflection" and s["body"] == spec["name"]:
                tip = int(np.argmin(((self.x - np.array(s["near_m"])) ** 2).sum(1)))
                self.tip = len(position)
                position.append(self.x[tip])
                basis.append(full[3 * tip:3 * tip + 3])
        self.cms.modeBasis, self.cms.xRef = np.vstack(basis), np.concatenate(position)
        self.cms.trigList, self.cms.nNodes = [], len(position)


class Model:
    def __init__(self, machine, meshes):
        self.machine = machine
        self.flexible = {b["name"]: Flexible(b, meshes[b["name"]], machine["sensor"])
                         for b in machine["body"] if b["kind"] == "flexible"}

    def local(self, at):
        return np.array(at["point_m"]) if "point_m" in at else self.flexible[at["body"]].point[at["interface"]]

    def pose(self, run):
        """Origins and angles of the undeformed bodies: angles as given, loops closed by least squares."""
        machine = self.machine
        given = {}
        for a in machine["angle"]:
            minus = run[f"angle_{a['minus']}_rad"] if "minus" in a else 0.0
            given[a["body"]] = run[f"angle_{a['name']}_rad"] - minus
        rigid = [b["name"] for b in machine["body"] if b["kind"] == "rigid"]
        welded = {j["to"]["body"]: j["from"]["body"] for j in machine["joint"] if j["kind"] == "fixed"}
        free = [b for b in rigid if b not in given and b not in welded]
        start = {b["name"]: math.radians(b.get("start_angle_deg", 0.0)) for b in machine["body"] if b["kind"] == "rigid"}

        def place(angles):
            turn = {"ground": 0.0, **given, **dict(zip(free, angles))}
            turn.update({b: turn[parent] for b, parent in welded.items()})
            origin = {"ground": np.zeros(3)}
            for j in machine["joint"]:
                f, t = j["from"], j["to"]
                if t["body"] not in origin:
                    at = origin[f["body"]] + RotationMatrixZ(turn[f["body"]]) @ self.local(f)
                    origin[t["body"]] = at - RotationMatrixZ(turn[t["body"]]) @ self.local(t)
            return origin, turn

        def gaps(angles):
            origin, turn = place(angles)
            out = [np.zeros(2)]
            for j in machine["joint"]:
                ends = [origin[e["body"]] + RotationMatrixZ(turn[e["body"]]) @ self.local(e) for e in (j["from"], j["to"])]
                out.append((ends[1] - ends[0])[:2])
            return np.concatenate(out)

        found = least_squares(gaps, [start[b] for b in free], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert np.abs(found.fun).max() < 1e-9, "the loop does not close"
        return place(found.x)


def user_cpu_s():
    return os.times().user


def simulate(model, run, scheme, step_s, sample_s, friction, static_tolerance, full_newton):
    machine, payload = model.machine, run["payload_kg"]
    gravity = np.array(machine["gravity_m_per_s2"])
    origin, turn = model.pose(run)
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    ground = mbs.AddObject(ObjectGround())
    body, flexible = {"ground": ground}, {}
    for spec in machine["body"]:
        name = spec["name"]
        if spec["kind"] == "flexible":
            damping = spec["damping"]
            flexible[name] = model.flexible[name].cms.AddObjectFFRFreducedOrder(
                mbs, positionRef=origin[name].tolist(), rotationMatrixRef=RotationMatrixZ(turn[name]),
                gravity=gravity.tolist(), massProportionalDamping=damping["mass_factor_per_s"],
                stiffnessProportionalDamping=damping["stiffness_factor_s"])
            body[name] = flexible[name]["oFFRFreducedOrder"]
        else:
            xx, yy, zz, xy, xz, yz = spec["inertia_kg_m2"]
            com = np.array(spec["centre_of_mass_m"])
            inertia = RigidBodyInertia(mass=spec["mass_kg"], com=com, inertiaTensorAtCOM=True,
                                       inertiaTensor=np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
            _, body[name] = AddRigidBody(mainSys=mbs, inertia=inertia, nodeType=exu.NodeType.RotationEulerParameters,
                                         position=origin[name].tolist(), rotationMatrix=RotationMatrixZ(turn[name]),
                                         gravity=gravity.tolist())

    def marker(at, rigid):
        if "interface" in at:
            nodes = model.flexible[at["body"]].nodes[at["interface"]]
            kind = MarkerSuperElementRigid if rigid else MarkerSuperElementPosition
            return mbs.AddMarker(kind(bodyNumber=body[at["body"]], meshNodeNumbers=nodes, weightingFactors=[0.25] * 4))
        kind = MarkerBodyRigid if rigid else MarkerBodyPosition
        return mbs.AddMarker(kind(bodyNumber=body[at["body"]], localPosition=at["point_m"]))

    for j in machine["joint"]:
        mbs.AddObject(GenericJoint(markerNumbers=[marker(j["from"], True), marker(j["to"], True)],
                                   constrainedAxes=FREE[j["kind"]]))
    if payload > 0:
        at = machine["payload"]["at"]
        place = origin[at["body"]] + RotationMatrixZ(turn[at["body"]]) @ model.local(at)
        node = mbs.AddNode(NodePoint(referenceCoordinates=place.tolist()))
        mbs.AddObject(MassPoint(physicsMass=payload, nodeNumber=node))
        point = mbs.AddMarker(MarkerNodePosition(nodeNumber=node))
        mbs.AddLoad(Force(markerNumber=point, loadVector=(payload * gravity).tolist()))
        mbs.AddObject(SphericalJoint(markerNumbers=[marker(at, False), point]))

    store = dict(storeInternal=True, writeToFile=False)
    out = exu.OutputVariableType
    sensors, actuators, locks, pressures = {}, {}, {}, {}
    for c in machine["cylinder"]:
        ends = [marker(c["base"], False), marker(c["rod"], False)]
        area = math.pi / 4 * c["piston_diameter_m"] ** 2
        hose = math.pi / 4 * c["hose"]["diameter_m"] ** 2 * c["hose"]["length_m"]
        fluid, valve, start = c["fluid"], c["valve"], c["initial_pressure_pa"]
        n = c["name"]
        pressures[n] = mbs.AddNode(NodeGenericODE1(referenceCoordinates=[0, 0], initialCoordinates=[start, start],
                                                   numberOfODE1Coordinates=2))
        actuators[n] = mbs.AddObject(HydraulicActuatorSimple(
            markerNumbers=ends, nodeNumbers=[pressures[n]], offsetLength=c["closed_length_m"],
            strokeLength=c["stroke_m"], chamberCrossSection0=area,
            chamberCrossSection1=area - math.pi / 4 * c["rod_diameter_m"] ** 2, hoseVolume0=hose, hoseVolume1=hose,
            valveOpening0=0, valveOpening1=0, actuatorDamping=c["damping_n_s_per_m"],
            oilBulkModulus=fluid["bulk_modulus_oil_pa"], cylinderBulkModulus=fluid["bulk_modulus_cylinder_pa"],
            hoseBulkModulus=fluid["bulk_modulus_hose_pa"],
            nominalFlow=valve["flow_coefficient_m3_per_s_per_sqrt_pa"], systemPressure=valve["supply_pressure_pa"],
            tankPressure=valve["tank_pressure_pa"], useChamberVolumeChange=True))
        if friction:
            law = friction_force(c["friction"])
            mbs.AddObject(SpringDamper(markerNumbers=ends, referenceLength=1.0, springForceUserFunction=(
                lambda mbs, t, item, u, v, stiffness, damp, force, law=law: law(v))))
        points = [origin[e["body"]] + RotationMatrixZ(turn[e["body"]]) @ model.local(e) for e in (c["base"], c["rod"])]
        locks[n] = mbs.AddObject(DistanceConstraint(markerNumbers=ends, distance=float(np.linalg.norm(points[1] - points[0]))))
        sensors[f"length_{n}"] = mbs.AddSensor(SensorObject(objectNumber=actuators[n], outputVariableType=out.Distance, **store))
        sensors[f"velocity_{n}"] = mbs.AddSensor(SensorObject(objectNumber=actuators[n], outputVariableType=out.VelocityLocal, **store))
        sensors[f"pressure_{n}"] = mbs.AddSensor(SensorNode(nodeNumber=pressures[n], outputVariableType=out.Coordinates, **store))
    for a in machine["angle"]:
        node = flexible[a["body"]]["nRigidBody"]
        sensors[f"rotation_{a['name']}"] = mbs.AddSensor(SensorNode(nodeNumber=node, outputVariableType=out.RotationMatrix, **store))
        sensors[f"omega_{a['name']}"] = mbs.AddSensor(SensorNode(nodeNumber=node, outputVariableType=out.AngularVelocity, **store))
        sensors[f"alpha_{a['name']}"] = mbs.AddSensor(SensorNode(nodeNumber=node, outputVariableType=out.AngularAcceleration, **store))
    tip_body = next(n for n, f in model.flexible.items() if f.tip is not None)
    sensors["tip"] = mbs.AddSensor(SensorSuperElement(bodyNumber=body[tip_body], meshNodeNumber=model.flexible[tip_body].tip,
                                                      outputVariableType=out.DisplacementLocal, **store))
    mbs.Assemble()

    settings = exu.SimulationSettings()
    settings.staticSolver.newton.relativeTolerance = static_tolerance
    settings.staticSolver.newton.absoluteTolerance = min(static_tolerance, 1e-8)
    settings.staticSolver.numberOfLoadSteps = 10
    settings.staticSolver.verboseMode = 0
    settings.solution.file.write = False
    mbs.SolveStatic(settings, updateInitialValues=True)
    p = mbs.systemData.GetODE1Coordinates()
    for k, c in enumerate(machine["cylinder"]):
        force = float(np.atleast_1d(mbs.GetObjectOutput(locks[c["name"]], out.Force))[0])
        p[2 * k] += force / (math.pi / 4 * c["piston_diameter_m"] ** 2)
        mbs.SetObjectParameter(locks[c["name"]], "activeConnector", False)
    mbs.systemData.SetODE1Coordinates(p, exu.ConfigurationType.Initial)

    signals = {c["name"]: np.concatenate([[0.0], run[f"valve_{c['name']}_ratio"]]) for c in machine["cylinder"]}
    samples = len(next(iter(signals.values())))
    times = np.arange(samples) * sample_s

    def before_step(mbs, t):
        for n, signal in signals.items():
            u = float(np.interp(t, times, signal))
            mbs.SetObjectParameter(actuators[n], "valveOpening0", u)
            mbs.SetObjectParameter(actuators[n], "valveOpening1", -u)
        return True

    mbs.SetPreStepUserFunction(before_step)
    settings = exu.SimulationSettings()
    time = settings.timeIntegration
    time.endTime = (samples - 1) * sample_s
    time.numberOfSteps = (samples - 1) * round(sample_s / step_s)
    time.verboseMode = 0
    time.newton.useModifiedNewton = not full_newton
    time.newton.relativeTolerance, time.newton.absoluteTolerance = 1e-8, 1e-10
    time.generalizedAlpha.computeInitialAccelerations = True
    time.generalizedAlpha.spectralRadius = 0.7
    settings.solution.file.write = False
    settings.solution.sensors.writePeriod = sample_s
    settings.parallel.numberOfThreads = 1
    kind = exu.DynamicSolverType
    before = user_cpu_s()
    mbs.SolveDynamic(settings, solverType=kind.TrapezoidalIndex2 if scheme == "trapezoidal-index-2" else kind.GeneralizedAlpha)
    spent = user_cpu_s() - before
    read = lambda s: mbs.GetSensorStoredData(sensors[s])
    assert all(len(read(s)) == samples for s in sensors), "samples are missing"
    columns = {"run_id": np.full(samples, run["run_id"], np.uint64), "step": np.arange(samples, dtype=np.int32), "time_s": times}
    for n, signal in signals.items():
        columns[f"valve_{n}_ratio"] = signal
        columns[f"length_{n}_m"] = read(f"length_{n}")[:, 1]
        columns[f"velocity_{n}_m_per_s"] = read(f"velocity_{n}")[:, 1]
        columns[f"pressure_{n}_piston_pa"], columns[f"pressure_{n}_rod_pa"] = read(f"pressure_{n}")[:, 1:3].T
    for a in machine["angle"]:
        n = a["name"]
        rotation = read(f"rotation_{n}")
        columns[f"angle_{n}_rad"] = np.arctan2(rotation[:, 4], rotation[:, 1])
        columns[f"angular_velocity_{n}_rad_per_s"] = read(f"omega_{n}")[:, 3]
        columns[f"angular_acceleration_{n}_rad_per_s2"] = read(f"alpha_{n}")[:, 3]
    tip = read("tip")
    for k, axis in enumerate("xyz"):
        columns[f"deflection_tip_{axis}_m"] = tip[:, 1 + k]
    return columns, spent


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machine", required=True)
    parser.add_argument("--mesh", action="append", required=True, metavar="BODY=FILE")
    parser.add_argument("--runs", required=True)
    parser.add_argument("--out", required=True)
    parser.add_argument("--scheme", choices=["trapezoidal-index-2", "generalized-alpha"], default="generalized-alpha")
    parser.add_argument("--step-s", type=float, default=1e-4)
    parser.add_argument("--sample-s", type=float, default=0.005)
    parser.add_argument("--no-friction", action="store_true")
    parser.add_argument("--static-tolerance", type=float, default=1e-10, help="relative; the published reference has 1e-4")
    parser.add_argument("--full-newton", action="store_true", help="a new Jacobian in every iteration")
    a = parser.parse_args()
    model = Model(tomllib.load(open(a.machine, "rb")), dict(m.split("=", 1) for m in a.mesh))
    tables = []
    for run in pq.read_table(a.runs).to_pylist():
        columns, spent = simulate(model, run, a.scheme, a.step_s, a.sample_s, not a.no_friction,
                                  a.static_tolerance, a.full_newton)
        tables.append(pa.table(columns))
        print(f"run {run['run_id']}: {tables[-1].num_rows} samples, {spent:.3f} s user CPU", flush=True)
    os.makedirs(os.path.dirname(a.out) or ".", exist_ok=True)
    pq.write_table(pa.concat_tables(tables), a.out, compression="zstd")


if __name__ == "__main__":
    main()
