"""Writes a model for franka-sim that is stable under stiff control: adds the inertia of the geared rotors to a URDF.

usage: franka_sim_model.py URDF MJCF      reads URDF, writes MJCF
"""

import sys

import mujoco

ROTORS_KG_M2 = 0.6  # Without this inertia, a damping of 450 Nm s/rad is unstable with steps of one millisecond.


def main():
    spec = mujoco.MjSpec.from_file(sys.argv[1])
    joints = spec.worldbody.find_all("joint")
    for joint in joints:
        joint.armature = ROTORS_KG_M2
    spec.compile()
    with open(sys.argv[2], "w") as file:
        file.write(spec.to_xml())


main()
