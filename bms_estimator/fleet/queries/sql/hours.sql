-- One row per hour and pack, with the start time of the hour. Rows after the server's present hour are from a worker that did
-- not check the edge's clock. Needs: all_columns, merged_rows, valid_rows.
CREATE TEMP VIEW hours AS
SELECT *, make_timestamp(hour * 3600000000::BIGINT) AS time
FROM (
    SELECT * FROM all_columns
    UNION ALL BY NAME SELECT * FROM merged_rows
    UNION ALL BY NAME SELECT * FROM valid_rows
)
WHERE hour <= getvariable('now_hour') + 1
