-- Hours in which blocks arrived while the server's clock was wrong: hours in the future, and hours in which more packs were
-- quarantined than not, because wrong clocks of edges are independent of each other. Needs: quarantined, stored.
CREATE TEMP TABLE server_errors AS
WITH doubtful AS (
    SELECT pack, hour, received_hour FROM quarantined WHERE received_hour IS NOT NULL
    UNION ALL
    SELECT pack, hour, received_hour FROM stored WHERE received_hour > $present_hour + 1
),
hours_of_arrival AS (
    SELECT
        received_hour, count(*) AS rows, count(DISTINCT pack) AS packs, 3600 * median(received_hour - hour - 1) AS error_s
    FROM doubtful GROUP BY received_hour
    HAVING received_hour > $present_hour + 1 OR count(DISTINCT pack) >= $min_server_packs
),
correct AS (
    SELECT received_hour, count(DISTINCT pack) AS packs FROM stored
    WHERE received_hour IN (SELECT received_hour FROM hours_of_arrival) GROUP BY received_hour
)
SELECT received_hour, rows, error_s
FROM hours_of_arrival h LEFT JOIN correct c USING (received_hour)
WHERE received_hour > $present_hour + 1 OR h.packs > coalesce(c.packs, 0)
