/* A bus of SPI on which every device answers with what it is sent, in the same
 * transfer. It has one device, /dev/spidev0.0. umlkernel.py builds it into a kernel. */

#include <linux/err.h>
#include <linux/init.h>
#include <linux/platform_device.h>
#include <linux/spi/spi.h>
#include <linux/string.h>

static int send_back(struct spi_controller *bus, struct spi_device *device,
                     struct spi_transfer *one)
{
	if (one->rx_buf && one->tx_buf)
		memcpy(one->rx_buf, one->tx_buf, one->len);
	else if (one->rx_buf)
		memset(one->rx_buf, 0, one->len);
	return 0;
}

static struct spi_board_info chip = {
	.modalias = "spi-petra", /* one of the names that spidev takes */
	.max_speed_hz = 10000000,
};

static int __init loopback_init(void)
{
	struct platform_device *parent;
	struct spi_controller *bus;
	int error;

	parent = platform_device_register_simple("spi-loopback", -1, NULL, 0);
	if (IS_ERR(parent))
		return PTR_ERR(parent);
	bus = spi_alloc_master(&parent->dev, 0);
	if (!bus)
		return -ENOMEM;
	bus->bus_num = 0;
	bus->num_chipselect = 1;
	bus->mode_bits = SPI_CPOL | SPI_CPHA | SPI_CS_HIGH;
	bus->transfer_one = send_back;
	error = spi_register_controller(bus);
	if (error) {
		spi_controller_put(bus);
		return error;
	}
	return spi_new_device(bus, &chip) ? 0 : -ENODEV;
}
late_initcall(loopback_init);
