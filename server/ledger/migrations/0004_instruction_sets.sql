-- A run's last digits depend on the instruction-set level it was computed on, so one job is computed on
-- one level: that of the worker which begins it. NULL: nobody has yet.

ALTER TABLE workers ADD COLUMN instruction_set TEXT;
ALTER TABLE jobs ADD COLUMN instruction_set TEXT;
