/* Read times, currents and a temperature from standard input, and print the voltages of docs/cell/cell_step.c. */
#include <stdio.h>

#include "cell_step.c"

int main(void)
{
    cell_state_t state;
    float soc, temperature_c, dt_s, current_a;
    float before_a = 0.0f;
    if (scanf("%f %f", &soc, &temperature_c) != 2) {
        return 1;
    }
    cell_start(&state, soc);
    while (scanf("%f %f", &dt_s, &current_a) == 2) {
        cell_step(&state, 0.5f * (before_a + current_a), dt_s);
        printf("%.6f\n", (double)cell_voltage(&state, current_a, temperature_c));
        before_a = current_a;
    }
    return 0;
}
