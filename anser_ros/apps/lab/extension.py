"""States what this application adds to the core; `anser_ros.extensions` describes the tables."""

OFFLINE = {
    'compare': 'compare two evaluations of a session, paired, with bootstrap intervals',
    'loop': 'put an effect into simulated samples, find it blind, correct it, measure again',
    'measured': "other people's measurements: what they contain, and the error before and after",
    'paper': "redo the article's experiments: Tables II to V, Figs. 2 and 5 to 10",
}
ENGINES = ('calibration_engines:ENGINES',)
DIAGNOSES = ('few_poses',)
OBSERVERS = ('source_track:Sources',)
