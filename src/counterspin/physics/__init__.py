"""The physics of an accelerometer on a centrifuge: numbers in, numbers out, no files.

Modules, lowest first:

- `spindle`: the angle model of the spindle (Eq. 1-4) and its fit to a recorded angle
- `angle_error`: how far that fit may be from the true angle, and the effect on the motion
- `conditions`: conditions on which coefficients depend, such as temperature and time
- `effects`: the few kinds of what an error term does
- `grades`: how large the terms of an accelerometer are, by its grade
- `terms`: the table of all error terms and uncertain inputs
- `gravity`: the gravity that is expected at a site
- `frequency_response`: gain and phase of an accelerometer and its recorder, as sums of time shifts
- `accelerometer`: mountings, and the error model (Eq. 7)
- `table`: motion of a table on the arm, and of the instrument on it, in space
- `motion`: exact position, velocity and specific force of the platform, on a path with errors too;
  harmful acceleration
- `station`: where one reading is taken, at rest, on an arm or on a double turntable, and what
  centrifuge, fixture and dividing head do to it
- `quadrature`: single and double time integrals along a trajectory, to rounding
- `observation`: columns, the displacement per unit of each coefficient
- `closed_forms`: t^2 coefficients of terms at constant rate
- `own_velocity`: errors of a computer that takes its own velocity for the Coriolis acceleration
- `correction`: from an indication to the specific force, the error model's inverse; accelerometers
  corrected together, and how uncertain that leaves them
- `simulation`: what an imperfect system records, without linearisation
- `as_printed`: the paper's equations as printed, where they depart from the exact ones

Glossary
--------
frame
    East-north-up at the spindle axis; vectors are the last axis, shape (n, 3). The level
    platform's axes x, y, z point east, north, up.
accelerometer axes
    Input I, pendulous P, output O, right-handed: I x P = O.
spindle angle
    From east towards north; a negative rate turns the other way.
specific force
    What an accelerometer senses: acceleration relative to the Earth plus Coriolis acceleration,
    less plumb-line gravity (which points down). At rest it is g, upwards.
harmful acceleration
    The part of the specific force that is not motion relative to the Earth (Coriolis and
    gravity); the navigation computer removes it.
displacement
    The double integral of what is indicated less what is harmful; its error against the true
    displacement is linear in the coefficients.
column
    The displacement error per unit of one coefficient along a trajectory.
term
    One row of the table: something that may be wrong, how large it may be, and its effect.

Units are SI and angles radians unless said. Coefficients of the accelerometer are in g-units
(g, g/g, g/g^2, g/g^3, and rad for misalignments), g being the site's own plumb-line gravity.
"""
