/* The equations of torch_denkf.applications.imu in plain C, for learning its numbers: a trial takes ten milliseconds.
 * Errors of the orientation stand in the body's axes, which gives the same filter as errors in the world's.
 * State of errors: rotation 0, bias of the gyro 3, its matrix of errors 6, position 15, velocity 18, acceleration 21,
 * bias of the magnetometer 24, field northwards 27 and upwards 28, lag of the magnetometer 29,
 * stray field 30. */
#include <math.h>
#include <string.h>
#define N 33
enum { BIAS = 3, GYRO = 6, POSITION = 15, VELOCITY = 18, PUSH = 21, HARD = 24, NORTH = 27, UP = 28, LAG = 29, STRAY = 30 };

static void product(const double *a, const double *b, double *o) {
    double w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    double x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    double y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
    double z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
    double n = 1 / sqrt(w * w + x * x + y * y + z * z);
    o[0] = w * n, o[1] = x * n, o[2] = y * n, o[3] = z * n;
}
static void exponential(const double *v, double *o) {
    double a = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), s = a < 1e-8 ? 0.5 : sin(a / 2) / a;
    o[0] = cos(a / 2), o[1] = s * v[0], o[2] = s * v[1], o[3] = s * v[2];
}
static void matrix(const double *q, double R[3][3]) {
    double w = q[0], x = q[1], y = q[2], z = q[3];
    double M[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                      {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                      {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
    memcpy(R, M, sizeof M);
}
static void right_jacobian(const double *v, double J[3][3]) {
    double s = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], a = sqrt(s);
    double one = s < 1e-6 ? 0.5 - s / 24 : (1 - cos(a)) / s, two = s < 1e-6 ? 1. / 6 - s / 120 : (a - sin(a)) / (s * a);
    double K[3][3] = {{0, -v[2], v[1]}, {v[2], 0, -v[0]}, {-v[1], v[0], 0}};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double square = 0;
            for (int l = 0; l < 3; l++) square += K[i][l] * K[l][j];
            J[i][j] = (i == j) - one * K[i][j] + two * square;
        }
}
static void cross(const double *a, const double *b, double *o) {
    o[0] = a[1] * b[2] - a[2] * b[1], o[1] = a[2] * b[0] - a[0] * b[2], o[2] = a[0] * b[1] - a[1] * b[0];
}
/* Rows 0-2 of P, then its columns, times a 3 by 3 matrix. */
static void turned(double P[N][N], double J[3][3]) {
    for (int pass = 0; pass < 2; pass++)
        for (int j = 0; j < N; j++) {
            double v[3];
            for (int i = 0; i < 3; i++) {
                v[i] = 0;
                for (int l = 0; l < 3; l++) v[i] += J[i][l] * (pass ? P[j][l] : P[l][j]);
            }
            for (int i = 0; i < 3; i++) {
                if (pass) P[j][i] = v[i];
                else P[i][j] = v[i];
            }
        }
}
static void update(double P[N][N], double H[3][N], const double *r, const double *noise, double *q, double *x) {
    double PH[N][3], S[3][3], I[3][3], K[N][3], change[N];
    for (int i = 0; i < N; i++)
        for (int a = 0; a < 3; a++) {
            PH[i][a] = 0;
            for (int j = 0; j < N; j++) PH[i][a] += P[i][j] * H[a][j];
        }
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) {
            S[a][b] = a == b ? noise[a] : 0;
            for (int j = 0; j < N; j++) S[a][b] += H[a][j] * PH[j][b];
        }
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) {
            int a1 = (a + 1) % 3, a2 = (a + 2) % 3, b1 = (b + 1) % 3, b2 = (b + 2) % 3;
            I[b][a] = S[a1][b1] * S[a2][b2] - S[a1][b2] * S[a2][b1];
        }
    double size = S[0][0] * I[0][0] + S[0][1] * I[1][0] + S[0][2] * I[2][0];
    for (int i = 0; i < N; i++)
        for (int a = 0; a < 3; a++) K[i][a] = (PH[i][0] * I[0][a] + PH[i][1] * I[1][a] + PH[i][2] * I[2][a]) / size;
    for (int i = 0; i < N; i++)
        for (int j = i; j < N; j++) {
            P[i][j] -= K[i][0] * PH[j][0] + K[i][1] * PH[j][1] + K[i][2] * PH[j][2];
            P[j][i] = P[i][j];
        }
    for (int i = 0; i < N; i++) change[i] = K[i][0] * r[0] + K[i][1] * r[1] + K[i][2] * r[2];
    double turn[4], now[4], J[3][3];
    exponential(change, turn), product(q, turn, now), memcpy(q, now, sizeof now);
    right_jacobian(change, J), turned(P, J);
    for (int i = 3; i < N; i++) x[i] += change[i];
}

/* p: gyro, gyro_rate, gyro_walk, damping, motion, motion_unrest, accelerometer, magnetometer, magnetometer_rate,
 * magnetic_walk, field_walk, rest, gravity, stray, stray_unrest, stray_time; start: 33 standard deviations, those of the
 * rotation in the world's axes; state: 34 numbers. Writes orientations [T, 4], covariances of turns in the body's axes,
 * and states [T, 33], whose first three numbers are none. For a smoother kept, if any, [T, 3 * 33 * 33 + 37] gets the
 * transition of errors into a step, the forecast's covariance, the posterior's, and the forecast's orientation and state. */
void filter(int count, double dt, const double *gyro, const double *force, const double *field, const double *unrest,
            const double *disturbance, const unsigned char *rest, int nine, const double *moves, const double *p,
            const double *start, const double *state, double *orientation, double *cov, double *states, double *kept) {
    double P[N][N], q[4], x[N], R[3][3], J[3][3], turn[4], now[4];
    memset(P, 0, sizeof P), memcpy(q, state, sizeof q), memcpy(x + 3, state + 4, 30 * sizeof(double));
    double fades = exp(-dt / p[15]);
    matrix(q, R);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            for (int l = 0; l < 3; l++) P[i][j] += R[l][i] * start[l] * start[l] * R[l][j];
    for (int i = 3; i < N; i++) P[i][i] = start[i] * start[i];
    for (int t = 0; t < count; t++) {
        const double *w = gyro + 3 * t;
        double speed = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
        if (t) {
            double angles[3], D[3][3];
            for (int i = 0; i < 3; i++) {
                const double *m = x + GYRO + 3 * i;
                angles[i] = (w[i] - x[BIAS + i] - m[0] * w[0] - m[1] * w[1] - m[2] * w[2]) * dt;
            }
            exponential(angles, turn), product(q, turn, now), memcpy(q, now, sizeof now);
            matrix(turn, D), right_jacobian(angles, J);
            for (int pass = 0; pass < 2; pass++)
                for (int j = 0; j < N; j++) {
                    double e[3], v[3];
#define AT(i) (*(pass ? &P[j][i] : &P[i][j]))
                    for (int l = 0; l < 3; l++) {
                        int m = GYRO + 3 * l;
                        e[l] = AT(BIAS + l) + w[0] * AT(m) + w[1] * AT(m + 1) + w[2] * AT(m + 2);
                    }
                    for (int i = 0; i < 3; i++) {
                        v[i] = D[0][i] * AT(0) + D[1][i] * AT(1) + D[2][i] * AT(2);
                        v[i] -= (J[i][0] * e[0] + J[i][1] * e[1] + J[i][2] * e[2]) * dt;
                    }
                    for (int i = 0; i < 3; i++) AT(i) = v[i];
                    for (int i = 0; i < 3; i++) {
                        double s[3] = {AT(POSITION + i), AT(VELOCITY + i), AT(PUSH + i)};
                        for (int l = 0; l < 3; l++)
                            AT(POSITION + 3 * l + i) = moves[3 * l] * s[0] + moves[3 * l + 1] * s[1] + moves[3 * l + 2] * s[2];
                        AT(STRAY + i) *= fades;
                    }
                }
            for (int i = 0; i < 3; i++) {
                double s[3] = {x[POSITION + i], x[VELOCITY + i], x[PUSH + i]};
                for (int l = 0; l < 3; l++)
                    x[POSITION + 3 * l + i] = moves[3 * l] * s[0] + moves[3 * l + 1] * s[1] + moves[3 * l + 2] * s[2];
                P[i][i] += (p[0] * p[0] + p[1] * p[1] * speed) * dt;
                P[BIAS + i][BIAS + i] += p[2] * p[2] * dt;
                P[PUSH + i][PUSH + i] += p[3] * (p[4] * p[4] + p[5] * p[5] * unrest[t] * unrest[t]) * dt;
                P[HARD + i][HARD + i] += p[9] * p[9] * dt;
                x[STRAY + i] *= fades;
                double stray = p[13] * p[13] + p[14] * p[14] * disturbance[t] * disturbance[t];
                P[STRAY + i][STRAY + i] += stray * (1 - fades * fades);
            }
            if (kept) {
                double *F = kept + (long)t * (3 * N * N + N + 4);
                for (int i = 0; i < N * N; i++) F[i] = i / N == i % N;
                for (int i = 0; i < 3; i++)
                    for (int l = 0; l < 3; l++) {
                        F[i * N + l] = D[l][i], F[i * N + BIAS + l] = -J[i][l] * dt;
                        for (int m = 0; m < 3; m++) F[i * N + GYRO + 3 * l + m] = -J[i][l] * dt * w[m];
                        for (int m = 0; m < 3; m++) F[(POSITION + 3 * l + i) * N + POSITION + 3 * m + i] = moves[3 * l + m];
                        F[(STRAY + i) * N + STRAY + i] = fades;
                    }
            }
            P[NORTH][NORTH] += p[10] * p[10] * dt, P[UP][UP] += p[10] * p[10] * dt;
        }
        double *store = kept ? kept + (long)t * (3 * N * N + N + 4) + N * N : 0;
        if (store) {
            memcpy(store, P, sizeof P), memcpy(store + 2 * N * N, q, sizeof q);
            memcpy(store + 2 * N * N + 4, x, sizeof x);
        }
        for (int k = 0; k < 3; k++) {
            if ((k == 1 && !nine) || (k == 2 && !rest[t])) continue;
            double H[3][N], r[3], noise[3], u[3], v[3] = {x[STRAY], x[NORTH] + x[STRAY + 1], x[UP] + x[STRAY + 2]};
            memset(H, 0, sizeof H), matrix(q, R);
            if (k == 0)
                for (int i = 0; i < 3; i++) v[i] = x[PUSH + i] + (i == 2 ? p[12] : 0);
            for (int i = 0; i < 3; i++) u[i] = R[0][i] * v[0] + R[1][i] * v[1] + R[2][i] * v[2];
            double U[3][3] = {{0, -u[2], u[1]}, {u[2], 0, -u[0]}, {-u[1], u[0], 0}};
            if (k == 0)
                for (int a = 0; a < 3; a++) {
                    for (int i = 0; i < 3; i++) H[a][i] = U[a][i], H[a][PUSH + i] = R[i][a];
                    r[a] = force[3 * t + a] - u[a], noise[a] = p[6] * p[6];
                }
            if (k == 1) {
                double lag = x[LAG], c[3], n[3], z[3], W[3][3] = {{0, -w[2], w[1]}, {w[2], 0, -w[0]}, {-w[1], w[0], 0}};
                cross(w, u, c);
                double e[3];
                cross(w, R[0], e), cross(w, R[1], n), cross(w, R[2], z);
                for (int a = 0; a < 3; a++) {
                    for (int i = 0; i < 3; i++) {
                        H[a][i] = U[a][i];
                        for (int l = 0; l < 3; l++) H[a][i] += lag * W[a][l] * U[l][i];
                    }
                    H[a][HARD + a] = 1, H[a][LAG] = c[a], H[a][STRAY] = R[0][a] + lag * e[a];
                    H[a][NORTH] = H[a][STRAY + 1] = R[1][a] + lag * n[a];
                    H[a][UP] = H[a][STRAY + 2] = R[2][a] + lag * z[a];
                    r[a] = field[3 * t + a] - u[a] - lag * c[a] - x[HARD + a];
                    noise[a] = p[7] * p[7] + p[8] * p[8] * speed;
                }
            }
            if (k == 2)
                for (int a = 0; a < 3; a++) H[a][BIAS + a] = 1, r[a] = w[a] - x[BIAS + a], noise[a] = p[11] * p[11];
            update(P, H, r, noise, q, x);
        }
        if (store) memcpy(store + N * N, P, sizeof P);
        memcpy(orientation + 4 * t, q, sizeof q);
        for (int i = 0; i < 9; i++) cov[9 * t + i] = P[i / 3][i % 3];
        memcpy(states + N * t + 3, x + 3, sizeof x - 3 * sizeof(double));
    }
}
