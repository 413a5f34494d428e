"""A model that franka-sim can move stiffly: a robot's description, with what rotors behind gears add to the joints' inertia.

usage: franka_sim_model.py URDF MJCF      reads the first, writes the second
"""

import sys

import mujoco

ROTORS_KG_M2 = 0.6  # Without, its damping of 450 Nm s/rad makes steps of a millisecond unstable.


def main():
    spec = mujoco.MjSpec.from_file(sys.argv[1])
    joints = spec.worldbody.find_all("joint")
    for joint in joints:
        joint.armature = ROTORS_KG_M2
    spec.compile()
    with open(sys.argv[2], "w") as file:
        file.write(spec.to_xml())


main()
