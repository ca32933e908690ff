//! SLIDE networks: windows, training, evaluation, prediction
