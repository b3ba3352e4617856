/* A mass, damper, spring and Bouc-Wen friction driven by a force: Runge and Kutta's fourth order.

   drive: at every half step, 2 n substeps + 1 values; x: the displacement at n + 1 samples; by: its
   exact derivatives with respect to p, NP at each sample; p: sigma, q, p, mass, damping, stiffness,
   initial displacement, velocity and friction force. */
#include <math.h>

#define NP 9
#define NY (3 * (1 + NP)) /* displacement, velocity and friction force; then their derivatives */

static void rates(const double *y, double drive, const double *p, double *d)
{
    double side = y[1] < 0.0 ? -1.0 : 1.0, ahead = side * y[2];
    int rate = ahead >= 0.0 ? 1 : 2;
    double slope = p[0] - p[rate] * ahead, by_force = -p[rate] * side * y[1];
    d[0] = y[1];
    d[1] = (drive - p[4] * y[1] - p[5] * y[0] - y[2]) / p[3];
    d[2] = slope * y[1];
    for (int k = 0; k < NP; k++) {
        const double *s = y + 3 + 3 * k;
        double *e = d + 3 + 3 * k;
        e[0] = s[1];
        e[1] = -(p[4] * s[1] + p[5] * s[0] + s[2]) / p[3];
        e[2] = slope * s[1] + by_force * s[2];
    }
    d[5] += y[1];
    d[3 + 3 * rate + 2] -= ahead * y[1];
    d[13] -= d[1] / p[3];
    d[16] -= y[1] / p[3];
    d[19] -= y[0] / p[3];
}

void simulate(int n, int substeps, double interval, const double *drive, const double *p, double *x,
              double *by)
{
    double y[NY] = {p[6], p[7], p[8]}, h = interval / substeps, a[NY], b[NY], c[NY], d[NY], at[NY];
    for (int k = 0; k < 3; k++) y[3 + 3 * (6 + k) + k] = 1.0;
    for (int i = 0; i <= n; i++) {
        x[i] = y[0];
        for (int k = 0; k < NP; k++) by[NP * i + k] = y[3 + 3 * k];
        for (int j = 0; j < substeps && i < n; j++, drive += 2) {
            rates(y, drive[0], p, a);
            for (int k = 0; k < NY; k++) at[k] = y[k] + 0.5 * h * a[k];
            rates(at, drive[1], p, b);
            for (int k = 0; k < NY; k++) at[k] = y[k] + 0.5 * h * b[k];
            rates(at, drive[1], p, c);
            for (int k = 0; k < NY; k++) at[k] = y[k] + h * c[k];
            rates(at, drive[2], p, d);
            for (int k = 0; k < NY; k++) y[k] += h / 6.0 * (a[k] + 2.0 * (b[k] + c[k]) + d[k]);
        }
    }
}
