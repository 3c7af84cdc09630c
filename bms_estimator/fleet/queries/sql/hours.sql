-- One row per hour and pack, with the start time of the hour. Needs: once, maybe_twice, all_columns.
CREATE TEMP VIEW hours AS
SELECT *, make_timestamp(hour * 3600000000::BIGINT) AS time
FROM (
    SELECT * FROM all_columns
    UNION ALL BY NAME SELECT * FROM once
    UNION ALL BY NAME SELECT DISTINCT ON (pack, hour) * FROM maybe_twice
)
