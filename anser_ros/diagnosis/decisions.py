"""Holds the numbers by which explanations are accepted, compared and named.

Three measures are compared here. All are in units of the whitened sum of squares, in which noise
and the field model's own error, if they are as large as expected, have a mean of one per value
(noise alone has less):

- the *gain* of an effect, what it takes off the cross-validated sum of squares of blocks of time
  that took no part in fitting it;
- the gain of a fluctuation, what -2 log marginal likelihood falls by;
- the *power* of an effect, what it takes off the sum of squares of the data it was fitted to.

Gains are judged in units of the *misfit*, the mean square of the remaining residuals: among large
unexplained residuals a gain must be larger in proportion to be significant.

An effect declares the cost of its parameters (`Effect.complexity`), and the share of its power
that its model may miss (`Effect.inexact`).

Unless a number says otherwise, it was chosen by hand on injected effects with seeds below 100
(`test/injection.py`); cases of later seeds that led to a rule are named in `docs/log.md`.
"""

# --- what is seen without a fit: wiring, and frames that stand out ------------------------------
OWN_CORRELATION = 0.9
"""Correlation (0 to 1) with its own prediction from which a reading is its own, whatever its sign:
the prediction then leaves less than a fifth of its power. Smaller calls a reading reversed that is
hardly like its prediction; larger misses a reversed plug if there is another effect."""
POLARITY_GAIN = 0.3
"""A gain within this of -1 is a polarity: as far as a gain is expected from one (the prior of
`sensor_gain`). Smaller misses a turned sensor whose gain is off as well; larger takes a weak
sensor with a turned phase for one."""
OTHERS_CORRELATION, BETTER = 0.95, 0.1
"""Correlation (0 to 1) with another's prediction, and share of the power that its own leaves which
the other's may leave, from which a plug is in its socket. A looser pair takes neighbours that read
alike for exchanged ones; a stricter one misses an exchange if there are other effects."""
AS_LITTLE = 2.0
"""Power that an explanation of the wiring may leave over what the best one leaves, so that the one
with fewer faults is named; and parts that were set up anew, over what metal at rest leaves. Exact
symmetries leave the same; what is not one leaves tens of times as much. Smaller lets noise choose
between two names of the same fault."""
DEAD = 0.02
"""Share of the expected reading below which a channel receives nothing: a fifth of the leak that
`channel_crosstalk` expects, so that one that its neighbours leak into is not called dead.
Smaller, and a dead channel with such a leak is taken for a weak one; larger, and a weak
one is given up."""
READING_RATIO, FRAME_RATIO = 6.0, 2.5
"""Mean squares over the neighbours' median from which a reading (16 values with 8 emitters) or a
frame (ten times as many) is no member of the same distribution; normal noise in 8 values
or more passes less than once in 1e6. Of fewer values the ratio of so rare a noise is larger."""
RARE = 1e-6
"""Probability that noise alone makes so large a reading or frame: a session of 1000 frames of nine
readings then has one in a hundred sessions."""
JUMP_RATIO = 40.0
"""Mean square over the neighbours' median from which a frame stands out whose pose's own
directions are left in: the optical jitter along them is larger than the noise and differs from
pose to pose, so only a glitch stands out so far. Smaller takes jitter for glitches, larger keeps
glitches in the fit."""
PLACE_RATIO = 40.0
"""The same for readings and frames of a body that rested at each place for seconds: its neighbours
in time are centimetres away, and what the field's model misses differs between them, by up to 18
(a contact that fails has thousands). Smaller takes a model's errors for loose contacts."""
WHOLE_FRAME_SHARE = 0.5
"""Share of a frame's readings, and of frames that lost any, from which whole frames are out: more
bad than good, so that what is left of the frame is not to be believed either."""
LEAST_CHANNEL_SHARE = 0.2
"""Share of the frames with an outlier from which a channel that has it is named: of nine channels
that are hit by chance each has a ninth."""

# --- whether an effect is accepted -------------------------------------------------------------
TIME_FOLDS = 4
"""Parts of the cross-validation over time blocks: of the twenty blocks that are fitted each part
holds out five, as many as take no part at all. More cost a fit each, fewer leave less to fit
on."""
LEAST_GAIN = 40.0
"""Gain, in units of the misfit, that any effect must have before its parameters are paid for. The
best of 700 candidates gains about 15 on a clean session; smaller lets chance win now and then,
larger hides small effects."""
PER_PARAMETER = 6.0
"""Gain, in units of the misfit, that each parameter must have: a useless one gains about one on
the data it is fitted to and costs about one on held-out data. It is paid by a new effect and by
each further parameter of a course."""
LEAST_GAIN_SHARE = 0.002
"""Gain over the number of values, in units of the misfit, that an effect must have on top: what a
field model's own error lets an effect gain grows with the data, while chance doesn't."""
LEAST_GAIN_SHARE_BESIDE_METAL = 0.01
"""The same with metal, whose shape is never known and leaves what other effects can take up."""
LEAST_OF_EXCESS = 0.4
"""Share of what is left to explain that an explanation with freedom in time (a fluctuation, or
metal at another place in each block) must explain: less than that is another effect's trace along
its columns. Twice as much called a low pass a gain (`docs/log.md`)."""
LEAST_OF_NOISE = 0.05
"""Share of the noise's power that a fluctuation must explain: a field model's own error is alike
in neighbouring frames and channels, and any freedom takes some of it. Without it a clean session
got a loose axis that explains 0.015 (`docs/log.md`)."""
REMNANT = 0.01
"""Further metal with less than this share of the strongest metal's gain is what the model of that
one left."""
OWN_METAL = 2.0
"""Gain of metal at rest, over the power that the model states of its own error, everywhere and by
place, in all readings, below which it may be the model's: what was taken off a scan with metal
near leaves a field that is metal's, 1.1 times that power in `dirty/scan_metal`, the only one
tried. Larger hides faint metal (what moves a tool by 0.03 mm)."""
OWN_SHARE = 0.5
"""The same for any other effect. What a model misses has many shapes, of which one effect is part:
at most 0.42 of what the model stated, in 27 good recordings of a real tracker. Smaller names such
a part; larger misses what changed by less than the model states to be wrong by."""
COMPLETE = 3.0
"""Misfit up to which parts that were set up anew explain a session, so that they are its rival to
metal at rest. They have so many parameters that beside another effect they take off much of what
metal does; a model that understates its error left 1.7. Smaller names metal where a source was
moved; larger misses metal beside another effect."""
MOST_METALS = 2
"""Active pieces of metal beside which no further metal is looked for. More let what the shapes
of these leave pass for another piece; fewer leave a second piece to be taken for other effects."""
MOST_DOUBTFUL = 2
"""With so many active effects that are not the same in all parts of the data, something else is
the cause, and further effects would only stand in for it: the search ends."""
CLEAR_GAIN = 5.0
"""An effect whose parameters stand so many times above what it must gain (by their covariance) is
kept without the fit of all the others without it."""
DISTINGUISHABLE = 0.05
"""A candidate of whose power the active fluctuations leave less than this share (0 to 1) cannot
be distinguished from them. Smaller fits candidates that only noise decides on; larger hides
effects behind a fluctuation."""

# --- which candidates are fitted in full -------------------------------------------------------
LEAST_PROBE_GAIN = 0.5
"""Share of the best fitted gain that a candidate's probe must promise. The probe is linear and
may promise too little, by less than this for the effects that there are."""
OPEN_FINALISTS = 3
"""Fluctuations that are fitted in full in each round. Fewer may pass over the right one, whose
probe is only linear; each further one costs the time of a fit."""
SITES_PER_EFFECT = 2
"""Sites (channels, coils, places) of one effect that are fitted in full in each round. With one, a
wrong site whose probe happens to promise more shuts out the right one; more cost a fit each."""

# --- which of several explanations is taken ----------------------------------------------------
AS_GOOD, AS_GOOD_PER_PARAMETER = 10.0, 4.0
"""Gain, in units of the misfit, that a simpler explanation may lack: so much, and so much for each
parameter that it spares. Together they are less than what a further effect with as many parameters
must gain (`LEAST_GAIN`, `PER_PARAMETER`), so what is given up would not have been accepted."""
ALIKE = 0.02
"""Share of a gain by which two explanations may differ that the data do not distinguish: metal of
an unknown shape leaves about as much. Within it a rival is listed, and metal rests."""
STEADY = 0.8
"""Share of a fluctuation's gain from which a constant, or a curve, of the same coil or channel is
tried first: freedom in every frame also takes off what is another effect's."""
FROM_OTHERS = 2.0
"""What a fluctuation takes off the others' unexplained residuals, over what would be lost if all
values along its columns were alike. It is taken off the fluctuation's gain."""
NOTHING_LEFT = 1.04
"""Misfit over the noise's up to which nothing but noise is left, so that the simplest of the
explanations that reach it is taken."""
SOMETHING_LEFT = 1.02
"""Misfit over the noise's from which there is something to explain: a body is made richer only
above it, and below it nothing that stays speaks against an effect."""
COARSE_REMAINDER = 1.3
"""The same for a first, coarse shape: the finer one follows once all effects are known. Smaller
spends modes on what effects that are not found yet do; larger leaves so much of the metal that
other effects stand in for it."""

# --- whether metal moves or rests --------------------------------------------------------------
LEAST_PATH_GAIN = 1.05
"""Factor by which metal at the best place for each block of time must explain more than at one
place, or it isn't tried as metal that moves. Smaller tries it for what noise gives so much
freedom; larger overlooks metal that moves little."""
LEAST_MOTION_GAIN = 100.0
"""Gain, in units of the misfit, that metal that moves must have over metal at rest, beside the
shares above: its course and shape cost some dozens of parameters."""
NO_RIVAL = 0.25
"""Metal at rest that by itself explains less than this share (0 to 1) of what moving metal
explains is no rival to it. Smaller spends fits on metal at rest that cannot win; larger lets
moving metal be named without asking whether rest and one more effect would do."""
LIMITS_LEFT, REST_LEFT = 2.0, 0.5
"""What the linear score of an effect beside metal at rest may leave for it to be fitted: so many
times what the two must come down to, and such a share (0 to 1) of what metal at rest leaves alone.
Smaller passes over effects whose fit explains more than their score."""
MOST_EFFECTS_AT_REST = 3
"""Effects that are tried together with metal at rest before metal counts as moving. Fewer let
metal move for what rest and one more effect explain; each further one costs a full fit."""

# --- whether an effect is confirmed and named --------------------------------------------------
TIME_PARTS = 6
"""Parts of the session in which an effect is fitted again: enough to see a change, few enough that
each has the poses that tell the parameters."""
LARGEST_VARIATION = 0.1
"""Share of an effect's power, and of what the model states as its own error, that refits in parts
of the data may take off besides. What is truly there varies by what its model is wrong by
(`Effect.inexact`: 1 % for most), and by chance: normal noise alone lets the refits of six parts of
the time take off some 3 with one parameter each and 8 with six, which is a share only of an effect
of little power. Larger confirms what stands in for another effect; smaller refuses effects whose
model is only near the truth, as metal's is."""
LEAST_OF_THE_REST = 0.2
"""An effect that takes off less than this share of what stays unexplained is not named: something
larger is unknown, and the effect is probably its trace."""
LEAST_POWER_SIGMAS = 6.0
"""Standard deviations of the noise's power from which a remainder counts. A normal variable passes
it once in 1e9, the power of normal noise in one cell of 400 frames once in 5e7. Noise that depends
on its neighbours passes oftener. One test per effect is made."""
MODEL_ERROR = 1.3
"""Variance over the noise's up to which a field model may be wrong, whatever it says: of a board
beyond what was scanned. It is not held against an effect on everything."""
MANY = 3
"""So many effects of one name, or on one channel, stand in for something else that they share."""
CHANGED = 0.1
"""Share of the largest change from which an effect counts as acting on a cell (what one channel
reads of one emitter): taking the pose out spreads a trace of each change over all of them."""

# --- whether what stays is noise ---------------------------------------------------------------
LEAST_NOISE_GROWTH = 1.15
"""Factor from which noise counts as grown. A channel's spread over 400 frames of eight emitters is
known to 1 %, so it is no chance."""
FEWEST_OUTLIERS = 0.004
"""Share of frames from which outliers are named. Normal noise makes none in a session."""
KNOWN_SIGMAS = 3.0
"""Standard deviations by which a share of frames may exceed the one that the model knows of, which
chance alone does in one session of 700."""
MOST_EXCESS_OF_OUTLIERS = 0.3
"""Unexplained power, over that of noise and of the error that the model states, up to which frames
that stand out are outliers: a model that is wrong by more makes some itself. Larger names outliers
that are another effect's, and with no bound a hum; smaller leaves true ones unnamed if there is a
small unknown (`docs/log.md`)."""

# Each of the next four lies above all that normal noise reached in 200 draws of 100 frames with 48
# readings; more frames or readings reach less.
BOUNDED_VALUES = 4800
"""Values on which these were chosen: of fewer, noise reaches more, by the share's root."""
LEAST_CORRELATION = 0.06
"""Correlation (-1 to 1) with a frame before from which residuals have a memory, just above the
0.053 that normal noise reached. Smaller refuses true noise; larger lets a hum pass for it."""
SHARED = 1.6
"""Largest eigenvalue of the readings' correlations, over the edge for independent ones, from which
they share something. Noise reached 1.03, and the rest is room for a field model's error, which is
alike in a few readings: smaller takes that for a disturbance, larger takes a common disturbance
for noise."""
WITH_SIZE = 0.08
"""Correlation of squared residuals with the squared reading from which they depend on it, twice
the 0.036 that normal noise reached. Smaller refuses true noise; larger lets a gain that rattles
pass for it."""
NOT_NORMAL = 0.35
"""Excess kurtosis (0 for a normal variable) from which residuals are not normal, half as much
again as the 0.22 that normal noise reached. Smaller refuses true noise; larger lets rounding pass
for it."""

# --- what a remainder depends on ---------------------------------------------------------------
SIGNIFICANT = 1e-5
"""Probability in noise below which a dependence is one; eight variables are tested, on residuals
whose noise is only estimated. Larger reports chance, smaller needs more frames to see anything."""
LEAST_DEPENDENCE = 0.005
"""Share (0 to 1) of the residual power that a dependence must explain, beyond chance, to be
reported. Smaller reports what is certain only because there are many frames, as a model's small
error; larger leaves a weak dependence unsaid."""
STRUCTURED, UNSTRUCTURED = 0.03, 0.1
"""Unexplained power over the floor's from which it is reported: where it depends on something, and
where no test finds on what. Smaller reports a correct model's own error; larger keeps silent about
what is there."""
DEPENDENT = 0.05
"""Unexplained power over the floor's from which it is reported what it depends on. Smaller gives
names to dependences of next to nothing; larger leaves a remainder without the hint where to
look."""


def as_good(spared: int) -> float:
    """Return the gain, in units of the misfit, that an explanation may lack that spares so many
    parameters; with none it may lack nothing.
    """
    return AS_GOOD + AS_GOOD_PER_PARAMETER * spared if spared > 0 else 0.0
