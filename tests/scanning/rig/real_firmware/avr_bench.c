/* A stage around the real firmware: an ATmega328P running a GRBL hex file at 16 MHz, behind a pseudo-terminal.
 *
 * The firmware is not part of this repository; this program only gives it what a board gives it: a serial line with a
 * board's habits (the processor restarts when the port is opened), three screws that count step pulses with their
 * direction, limit switches, and an eye on the laser output. What it sees and what it is told lies in a shared file of
 * 64-bit integers, so a test reads the carriage itself and not what the firmware says of it.
 *
 * cc -O2 -o avr_bench avr_bench.c $(pkg-config --cflags --libs simavr)
 * ./avr_bench FIRMWARE.hex STATE_FILE        prints the terminal's name on its first line and runs until it is killed
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "sim_avr.h"
#include "sim_hex.h"
#include "avr_eeprom.h"
#include "avr_ioport.h"
#include "avr_timer.h"
#include "avr_uart.h"

enum { /* seen */
	CYCLES, X_STEPS, Y_STEPS, Z_STEPS, LASER_DUTY, RESTARTS, PORT_OPEN, X_PULSES, BYTES_LOST,
	/* told */
	AS_FAST_AS_POSSIBLE = 16, RESTART_WANTED, RESTART_ON_OPEN_MS, SWITCH_ABOVE, SWITCH_BELOW, HOLD_BUTTON,
	WORDS = 32
};

enum { CPU_HZ = 16000000, SLICE = 8000, BYTE_CYCLES = 1389 /* ten bits at 115200 baud */, BACKLOG = 4096 };
enum { TCCR0B_AT = 0x45, TCNT0_AT = 0x46, CLOCK_BY_8 = 2, OCR1AL_AT = 0x88, TCCR2A_AT = 0xB0, OCR2A_AT = 0xB3, COM2A1_BIT = 0x80 };

static volatile int64_t *word;
static avr_t *avr;
static avr_irq_t *uart_in;
static uint8_t to_board[BACKLOG], from_board[BACKLOG];
static size_t to_head, to_tail, from_length;
static uint64_t asleep_until;
static int direction[3];
static int uart_full, pins_known;
static uint8_t *code;
static uint32_t code_size, code_base;

static void on_step(struct avr_irq_t *irq, uint32_t level, void *axis_of)
{
	int axis = (int)(intptr_t)axis_of;
	(void)irq;
	if (!level)
		return;
	word[X_STEPS + axis] += direction[axis] ? -1 : 1;
	if (!axis)
		word[X_PULSES]++;
}

static void on_direction(struct avr_irq_t *irq, uint32_t level, void *axis_of)
{
	(void)irq;
	direction[(int)(intptr_t)axis_of] = level != 0;
}

static void on_byte_out(struct avr_irq_t *irq, uint32_t value, void *unused)
{
	(void)irq, (void)unused;
	if (from_length < sizeof from_board)
		from_board[from_length++] = (uint8_t)value;
	else
		word[BYTES_LOST]++;
}

static void on_uart_full(struct avr_irq_t *irq, uint32_t value, void *full)
{
	(void)irq, (void)value;
	uart_full = (int)(intptr_t)full;
}

static avr_cycle_count_t byte_in(avr_t *of, avr_cycle_count_t when, void *unused)
{
	(void)of, (void)unused;
	if (to_tail != to_head && !uart_full)
		avr_raise_irq(uart_in, to_board[to_tail++ % BACKLOG]);
	return when + BYTE_CYCLES;
}

/* A chip whose timer 1 counts to zero interrupts at once; simavr's never does, and the first step would never come. */
static avr_cycle_count_t start_of_stepping(avr_t *of, avr_cycle_count_t when, void *timer)
{
	avr_timer_t *timer1 = timer;
	int counts_to_zero = !of->data[OCR1AL_AT] && !of->data[OCR1AL_AT + 1];
	if (counts_to_zero && avr_regbit_get(of, timer1->comp[AVR_TIMER_COMPA].interrupt.enable))
		avr_raise_interrupt(of, &timer1->comp[AVR_TIMER_COMPA].interrupt);
	return when + CPU_HZ / 20000;
}

/* The firmware presets timer 0 and starts it, its overflow ends the step pulse. simavr forgets the preset when the timer
 * starts, which would stretch every pulse to 128 us and melt the steps of a fast move together. */
static uint8_t pulse_preset;

static void on_pulse_preset(avr_t *of, avr_io_addr_t at, uint8_t value, void *unused)
{
	(void)of, (void)at, (void)unused;
	pulse_preset = value;
}

static avr_cycle_count_t end_of_pulse(avr_t *of, avr_cycle_count_t when, void *timer0)
{
	(void)when;
	avr_raise_interrupt(of, &((avr_timer_t *)timer0)->overflow);
	return 0;
}

static void on_pulse_start(avr_t *of, avr_io_addr_t at, uint8_t value, void *timer0)
{
	(void)at;
	if ((value & 7) == CLOCK_BY_8)
		avr_cycle_timer_register(of, (256 - pulse_preset) * 8, end_of_pulse, timer0);
}

static void drive(char port, uint8_t mask, uint8_t value)
{
	avr_ioport_external_t external = {.name = port, .mask = mask, .value = value};
	avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(port), &external);
	for (int pin = 0; pin < 8; pin++)
		if (mask & (1 << pin))
			avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(port), pin), (value >> pin) & 1);
}

static void switches(void)
{
	static const int limit_bit[3] = {1, 2, 4};
	static uint8_t before_b, before_c;
	uint8_t b = 0x16, c = 0x27;
	for (int axis = 0; axis < 3; axis++) {
		int64_t at = word[X_STEPS + axis];
		if (at > word[SWITCH_ABOVE] || at < word[SWITCH_BELOW])
			b &= ~(1 << limit_bit[axis]);
	}
	if (word[HOLD_BUTTON])
		c &= ~2;
	if (!pins_known || b != before_b)
		drive('B', 0x16, b);
	if (!pins_known || c != before_c)
		drive('C', 0x27, c);
	before_b = b, before_c = c, pins_known = 1;
}

static avr_timer_t *timer_named(char name)
{
	for (avr_io_t *io = avr->io_port; io; io = io->next)
		if (!strcmp(io->kind, "timer") && ((avr_timer_t *)io)->name == name)
			return (avr_timer_t *)io;
	abort();
}

/* A fresh processor with the old EEPROM. (simavr's own reset leaves timers and pins in a state no chip comes up in.) */
static void restart(int64_t bootloader_ms)
{
	static uint8_t memory[1024];
	avr_eeprom_desc_t eeprom = {.ee = memory, .offset = 0, .size = sizeof memory};
	if (avr) {
		avr_ioctl(avr, AVR_IOCTL_EEPROM_GET, &eeprom);
		avr_terminate(avr);
		free(avr);
	} else {
		memset(memory, 0xFF, sizeof memory);
	}
	avr = avr_make_mcu_by_name("atmega328p");
	avr_init(avr);
	avr->frequency = CPU_HZ;
	avr->log = 0;
	avr_loadcode(avr, code, code_size, code_base);
	avr->codeend = avr->flashend;
	eeprom.ee = memory;
	avr_ioctl(avr, AVR_IOCTL_EEPROM_SET, &eeprom);

	uint32_t flags = 0;
	avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
	uint32_t uart = AVR_IOCTL_UART_GETIRQ('0'), port_d = AVR_IOCTL_IOPORT_GETIRQ('D');
	uart_in = avr_io_getirq(avr, uart, UART_IRQ_INPUT);
	avr_irq_register_notify(avr_io_getirq(avr, uart, UART_IRQ_OUTPUT), on_byte_out, NULL);
	avr_irq_register_notify(avr_io_getirq(avr, uart, UART_IRQ_OUT_XON), on_uart_full, (void *)0);
	avr_irq_register_notify(avr_io_getirq(avr, uart, UART_IRQ_OUT_XOFF), on_uart_full, (void *)1);
	for (intptr_t axis = 0; axis < 3; axis++) {
		avr_irq_register_notify(avr_io_getirq(avr, port_d, 2 + axis), on_step, (void *)axis);
		avr_irq_register_notify(avr_io_getirq(avr, port_d, 5 + axis), on_direction, (void *)axis);
	}
	avr_cycle_timer_register(avr, BYTE_CYCLES, byte_in, NULL);
	avr_cycle_timer_register(avr, CPU_HZ / 20000, start_of_stepping, timer_named('1'));
	avr_register_io_write(avr, TCNT0_AT, on_pulse_preset, NULL);
	avr_register_io_write(avr, TCCR0B_AT, on_pulse_start, timer_named('0'));
	uart_full = 0;
	to_tail = to_head;
	from_length = 0;
	pins_known = 0;
	word[RESTARTS]++;
	asleep_until = bootloader_ms * (CPU_HZ / 1000);
}

static void serve_port(int master)
{
	static int was_open = 0;
	struct pollfd state = {.fd = master, .events = POLLIN};
	poll(&state, 1, 0);
	int open_now = !(state.revents & POLLHUP);
	if (open_now && !was_open && word[RESTART_ON_OPEN_MS] >= 0)
		restart(word[RESTART_ON_OPEN_MS]);
	was_open = open_now;
	word[PORT_OPEN] = open_now;
	if (state.revents & POLLIN) {
		uint8_t bytes[256];
		ssize_t n = read(master, bytes, BACKLOG - (to_head - to_tail) < sizeof bytes ? 0 : sizeof bytes);
		for (ssize_t i = 0; i < n; i++)
			if (avr->cycle >= asleep_until) /* the bootloader swallows what comes too early */
				to_board[to_head++ % BACKLOG] = bytes[i];
	}
	if (from_length) {
		ssize_t n = open_now ? write(master, from_board, from_length) : (ssize_t)from_length;
		if (n > 0)
			memmove(from_board, from_board + n, from_length -= n);
	}
}

static int open_terminal(void)
{
	int master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
	if (master < 0 || grantpt(master) || unlockpt(master))
		return -1;
	int slave = open(ptsname(master), O_RDWR | O_NOCTTY); /* opened once: from then on a closed one hangs up */
	struct termios raw;
	tcgetattr(slave, &raw);
	cfmakeraw(&raw);
	tcsetattr(slave, TCSANOW, &raw);
	close(slave);
	return master;
}

static double now_s(void)
{
	struct timespec t;
	clock_gettime(CLOCK_MONOTONIC, &t);
	return t.tv_sec + t.tv_nsec * 1e-9;
}

int main(int count, char **argument)
{
	if (count != 3)
		return 2;
	int file = open(argument[2], O_RDWR);
	word = file < 0 ? MAP_FAILED : mmap(NULL, WORDS * 8, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
	if (word == MAP_FAILED)
		return 3;
	code = read_ihex_file(argument[1], &code_size, &code_base);
	int master = open_terminal();
	if (!code || master < 0)
		return 4;
	restart(0);
	word[RESTARTS] = 0;
	printf("%s\n", ptsname(master));
	fflush(stdout);

	double due = now_s();
	while (getppid() != 1) {
		uint64_t until = avr->cycle + SLICE;
		if (avr->cycle < asleep_until)
			avr->cycle = until;
		else
			while (avr->cycle < until)
				avr_run(avr);
		word[CYCLES] += SLICE;
		switches();
		word[LASER_DUTY] = avr->data[TCCR2A_AT] & COM2A1_BIT ? avr->data[OCR2A_AT] : 0;
		serve_port(master);
		if (word[RESTART_WANTED]) {
			word[RESTART_WANTED] = 0;
			restart(0);
		}
		due += SLICE / (double)CPU_HZ;
		double early = due - now_s();
		if (word[AS_FAST_AS_POSSIBLE] || early < -0.05)
			due = now_s();
		else if (early > 0)
			usleep((useconds_t)(early * 1e6));
	}
	return 0;
}
