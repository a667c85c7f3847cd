"""A parallel robot as Pinocchio sees it: legs and a free platform, held together by rigid constraints."""

import numpy as np
import pinocchio as pin
from pinocchio_model import PINOCCHIO_ORDER, to_inertia

from calib.dynamics.bodies import PRISMATIC, bodies_of
from calib.parallel.mechanism.closure import ClosedRobot, Posture

SMALL = np.array([1e-2, 0, 0, 1e-2, 0, 1e-2, 0, 0, 0, 0.1])


def from_inertia(inertia: pin.Inertia) -> np.ndarray:
    """Return the ten standard parameters of an inertia."""
    result = np.empty(10)
    result[PINOCCHIO_ORDER] = inertia.toDynamicParameters()
    return result


class ClosedTree:
    """Pinocchio's model of legs with bodies' parameters (B, 10) in the order of `ParallelModel.labels`.

    It wants a mass behind every joint: the last link of a rigid leg gets a small body, which the platform's own loses.
    """

    def __init__(self, known: ClosedRobot, parameters: np.ndarray):
        robot = known.robot
        rows = list(np.reshape(parameters, (-1, 10)))
        self.mechanism = known
        self.model = pin.Model()
        self.model.gravity = pin.Motion(np.array(robot.gravity), np.zeros(3))
        tips = []
        added_bodies = np.zeros(10)
        for leg in robot.legs:
            bodies = bodies_of(leg.chain)
            parent = 0
            for j in range(bodies.count):
                kind = "P" if bodies.kinds[j] == PRISMATIC else "R"
                joint = getattr(pin, f"JointModel{kind}{'XYZ'[bodies.axes[j]]}")()
                placement = pin.SE3(np.array(bodies.placements[j]))
                parent = self.model.addJoint(parent, joint, placement, f"{leg.name}.{j}")
                row = rows.pop(0) if j < leg.bodies else SMALL
                self.model.appendBodyToJoint(parent, to_inertia(row), pin.SE3.Identity())
            if leg.end == "rigid":
                attachment = pin.SE3(leg.attachment @ np.linalg.inv(leg.chain.tail))
                added_bodies = added_bodies + from_inertia(attachment.act(to_inertia(SMALL)))
            tips.append(parent)
        platform = self.model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "platform")
        platform_body = to_inertia(np.sum(rows, axis=0) - added_bodies)
        self.model.appendBodyToJoint(platform, platform_body, pin.SE3.Identity())
        self.contacts = pin.StdVec_RigidConstraintModel()
        for leg, tip in zip(robot.legs, tips):
            kind = pin.ContactType.CONTACT_6D if leg.end == "rigid" else pin.ContactType.CONTACT_3D
            tail = pin.SE3(np.array(leg.chain.tail))
            attachment = pin.SE3(np.array(leg.attachment))
            self.contacts.append(pin.RigidConstraintModel(kind, self.model, tip, tail, platform, attachment))
        self.data = self.model.createData()

    def accelerations(self, posture: Posture, v: np.ndarray, twist: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return q̈ (n_t + 6) of one posture: of the legs' joints, then the platform's in its own axes.

        Args:
            v, tau: (n_t,); twist: (6,) in the base's axes.
        """
        pose = pin.SE3(posture.pose[0])
        q = np.concatenate([posture.q[0], pin.SE3ToXYZQUAT(pose)])
        body = np.concatenate([pose.rotation.T @ twist[:3], pose.rotation.T @ twist[3:]])
        datas = pin.StdVec_RigidConstraintData()
        datas.extend([contact.createData() for contact in self.contacts])
        pin.initConstraintDynamics(self.model, self.data, self.contacts, datas)
        settings = pin.ProximalSettings(1e-14, 1e-10, 1000)
        velocity = np.concatenate([v, body])
        forces = np.concatenate([tau, np.zeros(6)])
        return pin.constraintDynamics(self.model, self.data, q, velocity, forces, self.contacts, datas, settings).copy()
