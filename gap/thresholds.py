"""The numbers that decide which effects are named and what the verdict is: what each of
them decides, and how it was set.

Errors are held-out rms over noise: 1 is what a perfect model leaves. "The gap" is the
error of the scene as it came. Unless a line says otherwise, a number was set on the
development half of the benchmark of logs (docs/lab/gap_measured.md), not on its final
half.
The rules that use them: docs/gap_method.md, "How it works".
"""

# ----- When the search goes on, and what a difference between two errors means

# Rms over noise that a right model may leave, because noise levels are known to 10-20 %
# only. Above it another effect is looked for.
NOISE_RMS_MAX = 1.15

# Laws are approximations (how dry friction reverses, how commands are held). Errors are
# compared after this share of the gap was added to both in quadrature, so that smaller
# differences cannot decide between two models.
MODEL_ERROR_SHARE = 0.015
# The same for the error of one channel alone, and for two rivals fitted together: there
# a smaller share of a large gap depends on how the law was written down.
CHANNEL_MODEL_ERROR_SHARE = 0.03

# Two errors within this share of each other are the same: held-out error varies so much
# with the choice of blocks.
SAME_ERROR = 0.05
# What an effect must take off the error, and a bigger model off one that it contains:
# supersets that are not needed gain 3-7 %.
NESTED_GAIN = 0.10
# Two models differ in time if this is larger than the p-value of their paired blocks
# (Wilcoxon). The rms hardly shows it where both are at the noise.
P_VALUE_MIN = 0.01
# The p-value above which a rival below the noise may still be as good as the effect.
RIVAL_P_VALUE = 0.05
# Of two effects neither of which contains the other, the one with less evidence gives
# way if the difference is larger than this: twice the logarithm of a ratio of
# likelihoods, 25 for five standard deviations (Comparison.evidence). Two that differ by
# less than the second number (three) do as well as each other.
EVIDENCE_MIN, SAME_EVIDENCE = 25.0, 9.0

# The same that an effect needs where all rows together are near the noise and only one
# channel is above CHANNEL_RMS_MIN: ten standard deviations.
BESIDE_NOISE_EVIDENCE = 100.0

# ----- An effect of one channel

# An effect that takes too little off the whole is kept if it takes this share off one
# channel that was above CHANNEL_RMS_MIN times its noise, and the gain of paired blocks
# has at least this Student's t.
CHANNEL_GAIN = 0.10
CHANNEL_T_MIN = 2.0
CHANNEL_RMS_MIN = 1.3

# ----- Groups: one kind at all joints or channels

# A member of a group stays if it is MEMBER_Z deviations from neutral and its channel is
# worse by MEMBER_GAIN without it, or if its channel is worse by CHANNEL_GAIN. From logs
# of two real arms, a Panda and an industrial arm.
MEMBER_Z = 3.0
MEMBER_GAIN = 0.02
MEMBERS_MIN = 2
# A single effect goes before a group if it closes this share of what the group does.
SINGLE_SHARE_OF_GROUP = 0.9

# ----- Ties and rivals

# A rival with more parameters than the effect and these is no tie: it has the effect as
# a special case.
EXTRA_PARAMETERS_MAX = 1
# Two candidates are rivals if the catalogue says that they are confused with each
# other, or if the error of one is at most this many times that of the other.
RIVAL_ERROR_RATIO = 1.3
# Deviations off neutral that an effect must be, with its rival free, to be needed
# beside it. Set on 17 pushes (docs/gap_contact.md, "Mass or friction").
NEEDED_Z = 5.0
# Both of two rivals are named only if the second takes this share off the held-out
# error that the first one leaves (the same pushes).
PAIR_GAIN = 0.02
# Rivals that are tried in the place of one of two effects that were added at once.
PAIR_RIVALS_MAX = 3

# ----- Two effects at once

# Candidates all pairs of which are tried against the best single effect.
PAIR_CANDIDATES = 10

# ----- Nuisances

# Tolerances beyond its limit from which a nuisance is a finding: among dozens of
# nuisances chance rarely moves one as far.
NUISANCE_EXCESS = 1.0
# The tolerance, in multiples of their size, with which effects that are chosen already
# may change while candidates are ranked: practically free.
FREE_TOLERANCE = 1e3

# ----- Dropping what is not certain

# An effect is dropped if, as the parts of the data have it, it is fewer standard
# deviations from neutral. Set after a drag was named for the log of an SO-101, which
# had another sign in each recording.
CONSISTENT_Z = 2.0
# The same beside other effects: of the dozens that are tried on what they leave, noise
# that goes together over a while imitates one or the other with 2 to 3.
CONSISTENT_Z_BESIDE = 3.0
# A kind whose parameters may end anywhere (a small patch with much friction does what a
# larger one with less does) is kept, whatever its intervals, if it takes this share off
# the held-out error; the second number is for one beside other effects.
UNBOUNDED_GAIN = 0.1
UNBOUNDED_GAIN_BESIDE = 0.25
# A fit that is repeated and leaves this much more of the held-out rows moved along a
# direction that the fitted rows do not determine: the parameters from before are kept.
REFIT_LOSS_MAX = 0.05

# ----- Recordings that differ

# Two recordings differ in a parameter if it is so many standard deviations of both
# apart, and by this share of the larger one: a law that is only nearly the world's has
# another best value at other speeds (dry friction that sticks 1.4 times as high was
# fitted 16 % apart).
DIFFERS_Z = 5.0
DIFFERS_SHARE = 0.3

# ----- How much is tried

# Where errors jump with parameters, so many of the best candidates are searched by
# blocks of time before one is chosen.
FINALISTS = 4

# ----- The verdict

# Without an effect: up to this error scene and recordings agree.
AGREEMENT_RMS_MAX = 1.5
# With all effects: a gap without a name remains if the error is larger than this and
# than this share of what it was.
UNEXPLAINED_RMS = 2.0
UNEXPLAINED_SHARE = 0.2
# Effects that leave such a gap are named only if they close this share of it, in
# simulation: a free parameter of the wrong law may close as much. Set after looking at
# the measured double pendulum (60 % closed) and at two cases whose effect is not in the
# catalogue (16 and 43 %).
CLOSED_SHARE_MIN = 0.5
# Where things touch, simulation decides between rivals that equations found nearly as
# good: their error may be this many times that of the best, and in simulation they must
# leave less than this share of what it leaves.
SIMULATED_RIVAL_RATIO = 1.3
SIMULATED_RIVAL_GAIN = 0.8
SIMULATED_RIVALS_MAX = 3
