-- Before a blob is removed, whether any other artifact has the same bytes.
CREATE INDEX artifacts_by_digest ON artifacts (digest);
-- Their keys know nothing of job and view: nobody finds them any more.
DELETE FROM artifacts WHERE kind = 'track-state';
